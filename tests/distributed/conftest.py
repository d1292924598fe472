"""Ray's workers give way to all other processes: beside other tests they would hardly get on."""

import os

os.environ.setdefault("RAY_worker_niceness", "0")
