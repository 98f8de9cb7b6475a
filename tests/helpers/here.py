"""An executor that runs tasks in this process, for tests that need no worker processes: each of those loads all
libraries."""

from __future__ import annotations

import json

from linprim_geo.jobs.executor import Executor, outcome_of
from linprim_geo.jobs.worker import run_task


class Here(Executor):
    """Runs tasks in order, with specification and result in JSON as for a worker. Replaces `open_executor`."""

    what = "this process"

    def __init__(self, cluster, shared, workers=0):
        super().__init__(shared)
        self.answers: list[dict] = []

    def capacity(self):
        return 1, 64.0

    def start(self, spec, task):
        self.answers.append(json.loads(json.dumps(run_task(json.loads(json.dumps(spec))))))
        return len(self.answers) - 1

    def ended(self, handles, seconds):
        return [(handle, outcome_of(self.answers[handle])) for handle in handles]

    def stop(self):
        pass
