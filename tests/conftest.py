"""The tests run in the surroundings of the command: one thread a worker, one cache of compiled kernels."""

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()
