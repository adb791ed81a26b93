"""Draw the picture at the top of the README: ten fingers at play beside the learning curve of each.

    python -m mtjax.train --env=finger-spin-vary-size --agent=sac-conditioned --preset=cpu --steps=4000000
    python docs/make_picture.py runs/FOLDER

It reads the run's metrics and its last checkpoint, plays one episode of every training task under the mean action, and
writes docs/pictures/fingers.gif. Every number in it is one of that run.
"""

import csv
import io
import sys
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

import mtjax
from mtjax.learning.evaluation import record
from mtjax.report import render
from mtjax.saved.policy import Policy

FRAMES = 24
STRIDE = 3  # of the 0.02 s between steps
FIRST = 200  # the spinner is at speed by then
WIDTH, HEIGHT = 136, 112  # of a finger
BESIDE = 330  # width of the curves
RENDERED = (312, 372)
SHOWN = (42, 90, 282, 288)  # the part of a rendered frame in which the finger moves
COLOURS = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, 10))


def fingers(policy: Policy) -> list[list[Image.Image]]:
    """Return the frames of every training task, each labelled with its size."""
    env, tasks = policy.env, policy.env.tasks("train")
    played = record(env, policy.agent, policy.state, tasks, jnp.int32(0))
    shown = slice(FIRST, FIRST + FRAMES * STRIDE, STRIDE)
    films = []
    for task, row in enumerate(played.rows):
        frames = render.film(env, int(row), np.asarray(played.kept.qpos[task, shown]), *RENDERED)
        label = f"{env.describe(int(row)).replace('=', ' ')}: {float(played.returns[task, 0]):.0f}"
        films.append([labelled(Image.fromarray(frame), label, COLOURS[task]) for frame in frames])
    return films


def labelled(image: Image.Image, text: str, colour: np.ndarray) -> Image.Image:
    """Return the part of an image that matters, with a line of text and a bar of the curve's colour."""
    image = image.crop(SHOWN).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, HEIGHT - 4, WIDTH, HEIGHT), fill=tuple(int(255 * x) for x in colour[:3]))
    draw.text((4, 2), text, fill="black")
    return image


def curves(folder: Path, policy: Policy, size: tuple[int, int]) -> Image.Image:
    """Return a drawing of every training task's return over environment steps."""
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    rows = [row for row in rows if row["seed"] == "0"]
    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    sizes = policy.env.task_values("train")
    for task, colour in enumerate(COLOURS):
        returns = [float(row[f"return_{task}"] or "nan") for row in rows]
        axes.plot([float(row["steps"]) / 1e6 for row in rows], returns, color=colour, lw=1.4)
    axes.set(xlabel="million environment steps", ylabel="return of training episodes", ylim=(0, 1000))
    axes.set_title(f"ten fingers, size {sizes[0]:.2f} to {sizes[-1]:.2f}", fontsize=10)
    axes.grid(color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    file = io.BytesIO()
    figure.savefig(file, dpi=100)
    return Image.open(file).convert("RGB").resize(size)


def main(folder: Path) -> None:
    """Write the animation."""
    policy = mtjax.load(folder)
    films = fingers(policy)
    beside = curves(folder, policy, (BESIDE, 2 * HEIGHT))
    images = []
    for frame in range(FRAMES):
        image = Image.new("RGB", (5 * WIDTH + BESIDE, 2 * HEIGHT), "white")
        for task, film in enumerate(films):
            image.paste(film[frame], (task % 5 * WIDTH, task // 5 * HEIGHT))
        image.paste(beside, (5 * WIDTH, 0))
        images.append(image.quantize(48, dither=Image.Dither.NONE))
    path = Path(__file__).parent / "pictures" / "fingers.gif"
    images[0].save(path, save_all=True, append_images=images[1:], duration=20 * STRIDE, loop=0, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
