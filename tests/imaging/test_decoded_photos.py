"""Cache of decoded photographs: each is decoded once, up to a limit, and again after its file changed."""

import os
import pickle

import numpy as np
import pytest

from linprim_geo.base.options import ExtractOptions, TrainOptions
from linprim_geo.imaging import photos
from linprim_geo.imaging.decoded_photos import DecodedPhotos
from linprim_geo.surface.extract import extract_mesh
from linprim_geo.synthetic.synth import synthesize
from linprim_geo.training.train import train


@pytest.fixture
def decoded(monkeypatch):
    """The photographs that were decoded, in order."""
    paths, read = [], photos.read_photo

    def counted(path, size=None):
        paths.append(str(path))
        return read(path, size)

    monkeypatch.setattr(photos, "read_photo", counted)
    return paths


def picture(grey: int, side: int = 4):
    return lambda: (np.full((side, side, 3), grey, np.uint8), None)


def test_photograph_is_decoded_again_only_after_its_file_changed(tmp_path):
    file, kept = tmp_path / "a.png", DecodedPhotos()
    file.write_bytes(b"first")
    os.utime(file, ns=(1, 1))
    first = kept.get("a", [file], picture(1))[0]
    first[:] = 0  # the caller's own
    again = kept.get("a", [file], picture(2))[0]
    assert (again == 1).all() and kept.used == first.nbytes
    again[:] = 0
    assert (kept.get("a", [file], picture(2))[0] == 1).all()
    os.utime(file, ns=(2, 2))
    assert kept.get("a", [file], picture(2))[0].max() == 2 and kept.used == first.nbytes
    file.unlink()
    assert kept.get("a", [file], picture(3))[0].max() == 3  # the decoder reports a missing file
    kept.clear()
    assert kept.used == 0


def test_first_photographs_stay_up_to_the_limit(tmp_path):
    file, kept = tmp_path / "a.png", DecodedPhotos(limit=100)
    file.touch()
    for key, side in (("a", 4), ("b", 5), ("c", 4)):  # 48, 75 and 48 bytes
        kept.get(key, [file], picture(1, side))
    again = [kept.get(key, [file], picture(2, side))[0].max() for key, side in (("a", 4), ("b", 5), ("c", 4))]
    assert again == [1, 2, 1] and kept.used == 96


def test_pickled_cache_is_empty(tmp_path):
    kept = DecodedPhotos(limit=100)
    kept.get("a", [tmp_path], picture(1))
    copy = pickle.loads(pickle.dumps(kept))
    assert copy.limit == 100 and copy.used == 0


def test_training_and_extraction_decode_every_photograph_once(tmp_path, decoded):
    synthesize(tmp_path / "room", shape="room", views=8, test_views=2, size=40, points=300, supersample=1)
    options = TrainOptions(iterations=10, max_primitives=300, sh_degree=0, evaluate_every=5)
    train(tmp_path / "room", tmp_path / "run", options=options, quiet=True)
    assert len(decoded) == len(set(decoded)) == 10
    decoded.clear()
    extract_mesh(tmp_path / "run", options=ExtractOptions(refine=1), quiet=True)
    assert len(decoded) == len(set(decoded)) == 8
