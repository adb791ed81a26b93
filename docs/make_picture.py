"""Draw the picture at the top of the README and of the site: ten cheetahs that one agent runs as.

    python docs/make_picture.py

It plays one episode of every training task of a policy that comes with mtjax, under the mean action, and writes
docs/pictures/cheetahs.webp. Every number in it is the return of the episode that is shown.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import mtjax
from mtjax.learning.evaluation import record
from mtjax.report import render

POLICY = "cheetah-run-vary-torso-length/ppo"
FRAMES = 24
STRIDE = 2  # of the 0.01 s between steps
FIRST = 300  # steps before the film, in which the cheetahs gain speed
COLUMNS = 5
WIDTH, HEIGHT = 200, 128  # of a cheetah
RENDERED = (320, 240)
SHOWN = (0, 25, 320, 230)  # the part of a rendered frame in which the cheetah moves
QUALITY = 55


def main() -> None:
    """Write the film."""
    policy = mtjax.load(POLICY)
    env = policy.env
    played = record(env, policy.agent, policy.state, env.tasks("train"), jnp.int32(0))
    shown = slice(FIRST, FIRST + FRAMES * STRIDE, STRIDE)
    films = []
    for task, row in enumerate(map(int, played.rows)):
        states = jax.tree.map(lambda x, task=task: x[task, shown], played.kept)
        frames = render.film(env, row, states, *RENDERED)
        label = env.describe(row).replace("torso-length=", "length ")
        films.append([labelled(frame, label, f"{float(played.returns[task, 0]):.0f}") for frame in frames])
    images = [side_by_side(frames) for frames in zip(*films, strict=True)]
    path = Path(__file__).parent / "pictures" / "cheetahs.webp"
    rest = {"save_all": True, "append_images": images[1:], "duration": 20 * STRIDE, "loop": 0}
    images[0].save(path, quality=QUALITY, method=6, **rest)
    print(f"{path}: {path.stat().st_size // 1024} kB")


def labelled(frame: np.ndarray, label: str, number: str) -> Image.Image:
    """Return the part of a frame that matters, with what is varied and, large, the return."""
    image = Image.fromarray(frame).crop(SHOWN).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(image)
    draw.text((8, 8), label, fill="white", font=ImageFont.load_default(15))
    draw.text((WIDTH - 8, 2), number, fill="white", font=ImageFont.load_default(32), anchor="ra")
    return image


def side_by_side(frames: tuple[Image.Image, ...]) -> Image.Image:
    """Return the frames of all tasks in rows of ``COLUMNS``."""
    whole = Image.new("RGB", (COLUMNS * WIDTH, -(-len(frames) // COLUMNS) * HEIGHT), "white")
    for task, frame in enumerate(frames):
        whole.paste(frame, (task % COLUMNS * WIDTH, task // COLUMNS * HEIGHT))
    return whole


if __name__ == "__main__":
    main()
