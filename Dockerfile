# What `make demo` runs, without make:
#   docker build -t sb3_chac .
#   docker run --rm -v "$PWD/logs:/sb3_chac/logs" sb3_chac        # table, curves and video in logs/demo
#   docker run --rm -it sb3_chac rl_zoo3 train --algo chac --env SafeDrive-v0 --progress
FROM python:3.11-slim-bookworm

RUN apt-get update && apt-get install --yes --no-install-recommends gcc libc6-dev git && rm -rf /var/lib/apt/lists/*
WORKDIR /sb3_chac
ENV OMP_NUM_THREADS=1 PIP_NO_CACHE_DIR=1 SDL_VIDEODRIVER=dummy

COPY constraints.txt ./
RUN pip install --constraint constraints.txt torch --index-url https://download.pytorch.org/whl/cpu
COPY . .
RUN pip install --constraint constraints.txt .

# The commands of the Makefile's target demo
CMD ["sh", "-ec", "\
    rl_zoo3 train --algo chac --env SafeDrive-v0 -n 15000 -params switch_after:8000 prefit_steps:2000 \
        --eval-freq 3000 --eval-episodes 10 --seed 0 --progress --verbose 0 --log-interval 1 --log-folder logs/demo; \
    sb3-chac evaluate logs/demo/chac/SafeDrive-v0_1/SafeDrive-v0.zip --scenarios 1000:1020 --beside guided scripted \
        --json logs/demo/evaluation.json --plot logs/demo/paths.png --video logs/demo/drive.mp4; \
    sb3-chac plot logs/demo/chac/SafeDrive-v0_1 --out logs/demo/curves.png"]
