"""Options of the training in blocks that several files test, and a comparison of two runs in blocks."""

from __future__ import annotations

from pathlib import Path

from linprim_geo.base.options import TrainOptions

OPTIONS = TrainOptions(
    iterations=160, max_primitives=300, sh_degree=1, threads=1, checkpoint_every=20, evaluate_every=0
)
ARGUMENTS = (
    "--iterations 160 --max-primitives 300 --sh-degree 1 --threads 1 --checkpoint-every 20 --evaluate-every 0 --quiet"
).split()
SAVED = ("training_frame.npz", "scene.npz", "scene.ply")
COUNT = 2


def assert_same(run: Path, reference: Path) -> None:
    """Checks that the saved files of two runs have the same bytes."""
    for name in SAVED:
        assert (run / name).read_bytes() == (reference / name).read_bytes(), name
