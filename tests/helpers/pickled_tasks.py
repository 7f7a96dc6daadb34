"""Tasks sent through pickle, without processes."""

import pickle

from pchem_pipeline.compute.executor import SerialExecutor


class PickledTasks(SerialExecutor):
    """Sends tasks and units through pickle, as a backend of other processes does."""

    shares_memory = False

    def map(self, function, items, on_result):
        super().map(pickle.loads(pickle.dumps(function)), pickle.loads(pickle.dumps(list(items))), on_result)
