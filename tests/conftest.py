"""The tests run in the surroundings of the command: one thread a worker, one cache of compiled kernels.

Hypothesis draws the same examples every time; HYPOTHESIS_PROFILE=explore draws new ones.
"""

import os

from hypothesis import settings

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()
settings.register_profile("steady", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "steady"))
