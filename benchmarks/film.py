"""The moving picture of the README: novice, takeover, hand back, and the self-learning policy of stage 2.

    python benchmarks/film.py      # writes docs/_static/takeover.gif, a minute of CPU time

The novice is SB3's SAC after 200K steps without a human (agents/sac-SafeDrive-v0.zip), the human the scripted driver with the
risk rule; stage 2 is agents/chac-SafeDrive-v0.zip. Map and seed decide all that is seen.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3 import SAC

from sb3_chac import CHAC, InterventionWrapper
from sb3_chac.evaluation.episodes import ModelDriver

HERE = Path(__file__).parent
OUT = HERE.parent / "docs" / "_static" / "takeover.gif"
FPS, SIZE, COLOURS, CAPTION = 10, (480, 360), 64, 34
MAPS = range(1000, 1050)
BEFORE, LONGEST, AFTER, STAGE_2 = 20, 60, 15, 60  # steps that are shown

SELF = "self-learning policy"  # as the display calls it
NOVICE, HUMAN, HANDED_BACK = "A novice drives", "The human takes over: this teaches the novice", "The human hands back"


def caption(frame: np.ndarray, text: str, colour: tuple[int, int, int]) -> Image.Image:
    """
    :param frame: shape (height, width, 3)
    :param text: below the picture
    :param colour: of the bar behind it
    """
    picture = Image.new("RGB", (SIZE[0], SIZE[1] + CAPTION), colour)
    picture.paste(Image.fromarray(frame).resize(SIZE, Image.Resampling.LANCZOS), (0, 0))
    draw = ImageDraw.Draw(picture)
    draw.text((SIZE[0] / 2, SIZE[1] + CAPTION / 2), text, fill="white", anchor="mm", font=ImageFont.load_default(16))
    return picture


def make_env() -> gym.Env:
    return gym.make("SafeDrive-v0", corridors=False, render_mode="rgb_array")


def takeover() -> list[Image.Image]:
    """Film the first takeover of the test maps that comes after a while and is not too long."""
    env = InterventionWrapper(make_env(), expert="scripted", rule="risk")
    env.arm()
    model = SAC.load(HERE / "agents" / "sac-SafeDrive-v0.zip", device="cpu")
    for number in MAPS:
        drives = run(env, model, number)
        print(f"map {number}: the human drove {sum(drives)} of {len(drives)} steps", flush=True)
        starts = [k for k in range(BEFORE, len(drives)) if drives[k] and not any(drives[k - BEFORE : k])]
        for start in starts:
            end = next((k for k in range(start, len(drives)) if not drives[k]), len(drives))
            if 15 <= end - start <= LONGEST and not any(drives[end : end + AFTER]) and end + AFTER < len(drives):
                return film(env, model, number, start, end)
    raise RuntimeError("No takeover of a fitting length on these maps.")


def run(env: InterventionWrapper, model: Any, number: int) -> list[bool]:
    """
    :return: who drove, step by step: True where it was the human
    """
    observation, _ = env.reset(seed=number, options={"scenario": number})
    drives, done = [], False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        drives.append(info["takeover"])
        done = terminated or truncated
    return drives


def film(env: InterventionWrapper, model: Any, number: int, start: int, end: int) -> list[Image.Image]:
    """
    Drive the same episode again, with pictures.

    :param start: first step of the takeover
    :param end: the step after its last one
    """
    observation, _ = env.reset(seed=number, options={"scenario": number})
    pictures = []
    for step in range(end + AFTER):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, _, info = env.step(action)
        assert info["takeover"] == (start <= step < end) or step < start - BEFORE, "the episode is not the same"
        if step >= start - BEFORE:
            text, colour = (NOVICE, (40, 110, 50)) if step < start else (HUMAN, (176, 120, 0))
            if step >= end:
                text, colour = HANDED_BACK, (40, 110, 50)
            pictures.append(caption(env.render(), text, colour))
    return pictures


def self_learning() -> list[Image.Image]:
    """Film a drive in stage 2, where the self-learning policy drives most: who drives, and how sure it is."""
    env = make_env()
    driver = ModelDriver(CHAC.load(HERE / "agents" / "chac-SafeDrive-v0.zip", device="cpu"), env, None)
    shares = np.array([hud["drives"] == SELF for hud in stage_2(env, driver)], float)
    start = int(np.convolve(shares, np.ones(STAGE_2), mode="valid").argmax())
    pictures = []
    for step, hud in enumerate(stage_2(env, driver)):
        if start <= step < start + STAGE_2:
            env.unwrapped.hud = hud  # type: ignore[attr-defined]
            text = f"Stage 2: the {hud['drives']} drives, confidence {hud['confidence']}"
            colour = (30, 80, 150) if hud["drives"] == SELF else (40, 110, 50)
            pictures.append(caption(env.render(), text, colour))  # type: ignore[arg-type]
    return pictures


def stage_2(env: gym.Env, driver: ModelDriver) -> Iterator[dict[str, Any]]:
    """
    Drive the first test map.

    :return: what the display tells of each step
    """
    observation, _ = env.reset(seed=0, options={"scenario": MAPS[0]})
    driver.reset()
    done = False
    while not done:
        observation, _, terminated, truncated, _ = env.step(driver(observation))
        done = terminated or truncated
        yield driver.hud


def save(pictures: list[Image.Image], path: Path) -> None:
    """
    :param pictures: all of one size; they share one palette, so that only what changes is stored
    """
    sheet = Image.new("RGB", (SIZE[0], SIZE[1] * 4))
    for row, picture in enumerate(pictures[:: max(1, len(pictures) // 4)][:4]):
        sheet.paste(picture, (0, row * SIZE[1]))
    palette = sheet.quantize(COLOURS, Image.Quantize.MEDIANCUT)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, save_all=True, append_images=others, duration=1000 // FPS, loop=0, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    pictures = takeover() + self_learning()
    save(pictures, arguments.out)
    print(f"Saved {arguments.out}: {len(pictures)} frames, {arguments.out.stat().st_size / 1e6:.2f} MB")
