import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for subprocesses

import torch as th

th.set_num_threads(1)
