"""Every option of the long-running commands: name, default, unit and help in one place, so that the command line,
the Python functions and a run's config.json cannot disagree."""

from __future__ import annotations

from dataclasses import dataclass, field


def option(default, text: str, choices: tuple = (), metavar: str | None = None):
    """A dataclass field that the command line turns into `--field-name` with `text` as its help."""
    return field(default=default, metadata={"help": text, "choices": choices, "metavar": metavar})


@dataclass(frozen=True)
class SceneOptions:
    """How a capture is read."""

    downscale: int = option(1, "average K by K pixels into one", metavar="K")
    masks: str = option("", "folder of foreground masks, if they are not where data sets usually keep them", metavar="DIR")
    sparse: str = option("", "COLMAP model to take points from, if it is not where data sets usually keep it", metavar="DIR")


@dataclass(frozen=True)
class TrainOptions:
    """How a scene is trained."""

    iterations: int = option(7000, "training steps, one view each")
    max_primitives: int = option(20_000, "the population never grows past this")
    initial_primitives: int = option(0, "primitives at the start; 0 chooses from the points and --max-primitives")
    sh_degree: int = option(2, "degree of the view-dependent colour, 0 to 3", choices=(0, 1, 2, 3))
    seed: int = option(0, "seed of everything random")
    threads: int = option(0, "worker threads; 0 uses every core; the result does not depend on it")
    background: str = option(
        "auto", "auto, fitted, random, black, white, or r,g,b in [0,1]; auto: random with alpha, else fitted"
    )
    dssim: float = option(0.2, "weight of D-SSIM in the loss; L1 has the rest")
    stop: float = option(1e-3, "transmittance below which a ray ends", metavar="T")
    checkpoint_every: int = option(1000, "steps between checkpoints", metavar="STEPS")
    evaluate_every: int = option(1000, "steps between scores on the held-out views; 0 scores only at the end", metavar="STEPS")
