"""Decision logs as datasets of Minari: what was driven trains the next policy."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from sb3_chac.common.contract import NOVICE_ACTION, TAKEOVER
from sb3_chac.datasets.writer import DatasetWriter, folder_to_make
from sb3_chac.deploy.log import read_log
from sb3_chac.deploy.metadata import NotDeployable
from sb3_chac.deploy.udp import Flag

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer


def dataset_of(log: Path, dataset: str | os.PathLike[str], env: gym.Env, overwrite: bool = False) -> tuple[Path, int, int]:
    """
    Write the transitions of a log. Each is an observation, what the vehicle executed until the next one (``executed`` of the
    packets), and that next one, with takeover, the policy's proposal as novice_action, and cost. Where packets were lost, an
    episode is cut. A reward that the vehicle did not tell is 0.

    :param log: of ``sb3-chac run``
    :param dataset: id for Minari's folder, or the folder to make; it ends with a version
    :param env: with the spaces of the vehicle
    :param overwrite: whether to replace a dataset of that name
    :return: the folder, and how many episodes and steps it holds
    :raises NotDeployable: if the log does not fit the environment, or holds no transition
    """
    metadata, decisions = read_log(log)
    shapes = [entry.shape for entry in metadata.inputs]
    if not isinstance(env.observation_space, gym.spaces.Box) or shapes != [env.observation_space.shape]:
        raise NotDeployable(f"{log} has observations of shape {shapes}, the environment has {env.observation_space}.")
    folder = folder_to_make(dataset, overwrite)
    settings = {"policy": f"{metadata.algorithm} {metadata.model_sha256[:12]}", "log": log.name}
    n_episodes = 0
    with DatasetWriter(folder, env, settings, overwrite) as writer:
        for lines in episodes_of(decisions):
            writer.add(episode_of(lines, env))
            n_episodes += 1
        if n_episodes == 0:
            raise NotDeployable(f"{log} holds no two consecutive observations with what was executed between them.")
        writer.finish()
        return folder, n_episodes, writer.steps


def episodes_of(decisions: Iterator[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    """Split decisions on valid observations where an episode begins, or packets are missing; at least two belong together."""
    lines: list[dict[str, Any]] = []
    for line in decisions:
        if not line.get("observation") or "problem" in line or "sequence" not in line:
            continue
        last = lines[-1] if lines else None
        goes_on = last is not None and last["session"] == line["session"] and line["sequence"] == last["sequence"] + 1
        ended = last is not None and last["flags"] & (Flag.TERMINATED | Flag.TRUNCATED)
        executed = line["executed"] is not None and None not in line["executed"]
        if not goes_on or ended or line["flags"] & Flag.START or not executed:
            if len(lines) > 1:
                yield lines
            lines = []
        lines.append(line)
    if len(lines) > 1:
        yield lines


def episode_of(lines: list[dict[str, Any]], env: gym.Env) -> "EpisodeBuffer":
    """
    Convert the lines of a log to an episode.

    :param lines: of one episode
    :return: the episode as Minari stores it, the infos of an action at the index of what followed it
    """
    from minari.data_collector import EpisodeBuffer

    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    after = lines[1:]
    actions = [np.clip(np.array(line["executed"], space.dtype), space.low, space.high) for line in after]
    flags = [Flag(line["flags"]) for line in after]
    terminated = [bool(flag & Flag.TERMINATED) for flag in flags]
    # An episode that was cut ends without a word of the vehicle
    truncated = [bool(flag & Flag.TRUNCATED) for flag in flags[:-1]] + [not terminated[-1]]
    proposals = [np.array(line["proposed"], space.dtype).reshape(space.shape) for line in lines[:-1]]
    infos = {
        TAKEOVER: np.array([False, *(bool(flag & Flag.BY_HUMAN) for flag in flags)]),
        NOVICE_ACTION: np.array([np.zeros(space.shape, space.dtype), *proposals]),
        "is_success": np.array([False, *(bool(flag & Flag.SUCCESS) for flag in flags)]),
    }
    if all(flag & Flag.COST for flag in flags):
        infos["cost"] = np.array([0.0, *(line["cost"] for line in after)])
    return EpisodeBuffer(
        observations=np.array([line["observation"][""] for line in lines], env.observation_space.dtype),
        actions=np.array(actions),
        rewards=[float(line["reward"] or 0.0) for line in after],
        terminations=terminated,
        truncations=truncated,
        infos=infos,
    )
