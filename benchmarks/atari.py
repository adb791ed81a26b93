"""Scores on Atari's games, in units in which 0 is a random policy's score and 1 a person's.

``atari_scores.csv`` holds both for 57 games: means over episodes of at most 108,000 frames, which begin after up to 30
idle steps. The person is a professional tester of games. The numbers are those by which the field normalises, read from
DQN Zoo (Quan and Ostrovski 2020; google-deepmind/dqn_zoo, 359945d, dqn_zoo/atari_data.py).
"""

import json
from pathlib import Path

import numpy as np
from report import read_lines

_FILE = Path(__file__).with_name("atari_scores.csv")
_SUITE, _VERSION = "envpool:", "-v5"

FIVE = ("BattleZone", "DoubleDunk", "NameThisGame", "Phoenix", "Qbert")
"""Games whose scores tell most of those of all others (Aitchison et al. 2023, "Atari-5")."""
TWENTY_SIX = (
    *("Alien", "Amidar", "Assault", "Asterix", "BankHeist", "BattleZone", "Boxing", "Breakout", "ChopperCommand"),
    *("CrazyClimber", "DemonAttack", "Freeway", "Frostbite", "Gopher", "Hero", "Jamesbond", "Kangaroo", "Krull"),
    *("KungFuMaster", "MsPacman", "Pong", "PrivateEye", "Qbert", "RoadRunner", "Seaquest", "UpNDown"),
)
"""Games of Kaiser et al. 2020, "Model-based reinforcement learning for Atari"."""

PROTOCOL = {
    "repeat_action_probability": 0.25,  # at every frame the last action may stay
    "full_action_space": True,
    "episodic_life": False,  # episodes end with the game, not with a life
    "use_fire_reset": False,
    "noop_max": 1,  # sticky actions are the only chance
    "reward_clip": False,
}
"""EnvPool's settings for games as Machado et al. 2018 recommend: actions that stick, all 18 of them, whole games."""
SETTINGS = (f"arguments={json.dumps(json.dumps(PROTOCOL))}", "time_limit=27000", "frames=4")
"""The same as words of a suite, with the limit of 108,000 frames and the pictures that an agent sees at once."""


def name(game: str) -> str:
    """Return the environment of a game."""
    return f"{_SUITE}{game}{_VERSION}"


def is_game(env: str) -> bool:
    """Return whether an environment is a game that has scores, or a mixture of such."""
    return all(each.removeprefix(_SUITE).removesuffix(_VERSION) in known() for each in env.split("+"))


def known() -> dict[str, tuple[float, float]]:
    """Return the scores of a random policy and of a person, by game."""
    return {line["game"]: (float(line["random"]), float(line["human"])) for line in read_lines(_FILE)}


def normalised(env: str, returns: np.ndarray) -> np.ndarray:
    """Return human-normalised scores of returns (S, T) of a game, or of a mixture's in its order."""
    games = [each.removeprefix(_SUITE).removesuffix(_VERSION) for each in env.split("+")]
    random, human = np.array([known()[game] for game in games]).T
    return (returns - random) / (human - random)
