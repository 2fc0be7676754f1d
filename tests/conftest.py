import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for subprocesses

import torch as th
from hypothesis import HealthCheck, settings

th.set_num_threads(1)

# No verdict on how fast the machine is
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")
