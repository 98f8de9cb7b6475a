"""LPIPS: closed forms for constructed weights, the definition, layouts of weight files, and invalid files."""

from __future__ import annotations

import csv
import importlib.machinery
import json
import math

import numpy as np
import pytest
import torch

from linprim_geo.base.errors import LinprimError
from linprim_geo.cli import main as cli
from linprim_geo.eval import lpips as module
from linprim_geo.eval.images import eval_images_run
from linprim_geo.eval.lpips import NETWORKS, Lpips, find_lpips

SMALLEST = {"alex": 31, "vgg": 16}


def backbone(network, seed=0):
    """Random weights under torchvision's names, so that features neither vanish nor grow."""
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, shape in NETWORKS[network].shapes().items():
        spread = math.sqrt(2 / math.prod(shape[1:])) if len(shape) > 1 else 0.1
        state[f"features.{name}"] = spread * torch.randn(shape, generator=generator)
    return state


def heads(network, seed=1):
    """Random heads under the names of the package `lpips`."""
    generator = torch.Generator().manual_seed(seed)
    return {
        f"lin{k}.model.1.weight": torch.rand((1, c, 1, 1), generator=generator)
        for k, c in enumerate(NETWORKS[network].taps)
    }


@pytest.fixture(autouse=True)
def nothing_at_hand(monkeypatch, tmp_path):
    """Hide all weights except those that a test makes."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of alex_features.pth, alex_heads.pth and the same of vgg, in the old format and in the new one."""
    folder = tmp_path_factory.mktemp("weights")
    for network in NETWORKS:
        new = network == "vgg"
        torch.save(backbone(network), folder / f"{network}_features.pth", _use_new_zipfile_serialization=new)
        torch.save(heads(network), folder / f"{network}_heads.pth", _use_new_zipfile_serialization=new)
    return folder


@pytest.fixture(scope="module")
def both(files):
    found, missing = find_lpips(files)
    assert missing == ""
    return {each.network.name: each for each in found}


def images(height, width, seed=3):
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3))
    return a.astype(np.float32), np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1).astype(np.float32)


# --- the distance ----------------------------------------------------------------------------------------


def layers_of(network):
    """torchvision's `features` down to the last compared layer, as plain modules, by the papers: (module, compared
    after it)."""
    conv, relu, pool = torch.nn.Conv2d, torch.nn.ReLU, torch.nn.MaxPool2d
    if network == "alex":
        return [
            conv(3, 64, 11, 4, 2),
            relu(),
            pool(3, 2),
            conv(64, 192, 5, 1, 2),
            relu(),
            pool(3, 2),
            conv(192, 384, 3, 1, 1),
            relu(),
            conv(384, 256, 3, 1, 1),
            relu(),
            conv(256, 256, 3, 1, 1),
            relu(),
        ], (1, 4, 7, 9, 11)
    modules, before = [], 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        modules += [pool(2, 2)] if modules else []
        for channels in block:
            modules += [conv(before, channels, 3, 1, 1), relu()]
            before = channels
    return modules, (3, 8, 15, 22, 29)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("as_3dgs", [False, True])
def test_distance_agrees_with_the_definition(network, as_3dgs, both):
    """The definition in float64 with torch modules."""
    modules, compared = layers_of(network)
    stack = torch.nn.ModuleList(modules).double()
    stack.load_state_dict({key.removeprefix("features."): value for key, value in backbone(network).items()})
    mean, spread = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    a, b = images(53, 66)
    found = []
    for image in (a, b):
        # The shift and scale of LPIPS are ImageNet's, rounded, for colours in [-1, 1].
        value = image.astype(np.float64) if as_3dgs else 2 * image.astype(np.float64) - 1
        shift, scale = np.round(2 * mean - 1, 3), 2 * spread
        x = torch.from_numpy(((value - shift) / scale).transpose(2, 0, 1)[None])
        features = []
        for k, layer in enumerate(stack):
            x = layer(x)
            if k in compared:
                features.append(x[0].detach().numpy())
        found.append(features)
    expected = 0.0
    for x, y, head in zip(*found, heads(network).values(), strict=True):
        x, y = (v / (np.sqrt((v**2).sum(0)) + 1e-10) for v in (x, y))
        expected += float(np.mean(np.einsum("c,chw->hw", head.numpy().ravel().astype(np.float64), (x - y) ** 2)))
    assert both[network].distance(a, b, as_3dgs=as_3dgs) == pytest.approx(expected, rel=2e-5) and expected > 0.05


@pytest.mark.parametrize("network", NETWORKS)
def test_distance_is_zero_for_equal_images_and_symmetric(network, both):
    a, b = images(40, 35)
    each = both[network]
    assert each.distance(a, a) == 0
    assert each.distance(a, b) == pytest.approx(each.distance(b, a), rel=1e-12) and each.distance(a, b) > 0
    rounded = (a * 255).astype(np.uint8)
    assert each.distance(rounded, b) == pytest.approx(each.distance(rounded.astype(np.float32) / 255, b), rel=1e-6)


def test_constructed_weights_agree_with_the_closed_form():
    """Only the first layer is compared. Its first two channels are red and 1, so features are (r, 1) / |(r, 1)|."""
    network = NETWORKS["vgg"]
    weights = {name: torch.zeros(shape) for name, shape in network.shapes().items()}
    for index in ("0", "2"):
        weights[f"{index}.weight"][0, 0, 1, 1] = 1  # the pixel itself
    weights["2.bias"][1] = 1
    head = [torch.zeros(c) for c in network.taps]
    head[0][:2] = torch.tensor([3.0, 5.0])
    each = Lpips(network, weights, head)
    a, b = (np.full((20, 24, 3), level, np.float32) for level in (0.6, 1.0))
    x, y = ((2 * level - 1 + 0.030) / 0.458 for level in (0.6, 1.0))
    u, v = (np.array([r, 1]) / math.hypot(r, 1) for r in (x, y))
    assert each.distance(a, b) == pytest.approx(3 * (u[0] - v[0]) ** 2 + 5 * (u[1] - v[1]) ** 2, rel=1e-5)
    # Half of the image: half of the distance.
    b[:, :12] = a[:, :12]
    assert each.distance(a, b) == pytest.approx(0.5 * (3 * (u[0] - v[0]) ** 2 + 5 * (u[1] - v[1]) ** 2), rel=1e-5)


@pytest.mark.parametrize("network", NETWORKS)
def test_small_images_are_refused(network, both):
    least = SMALLEST[network]
    a, b = images(least, least)
    assert both[network].distance(a, b) > 0
    title = NETWORKS[network].title
    with pytest.raises(
        LinprimError,
        match=f"the image is {least}x{least - 1}, LPIPS by {title} wants {least}x{least} at least",
    ):
        both[network].distance(a[1:], b[1:])


# --- weights ---------------------------------------------------------------------------------------------


def test_weights_in_one_file_are_accepted(tmp_path, both):
    """The package keeps torchvision's layer numbers in slices and stores the heads twice."""
    state = {}
    for key, value in backbone("alex").items():
        index, what = key.removeprefix("features.").split(".")
        state[f"net.slice{1 + (int(index) > 2) + (int(index) > 5)}.{index}.{what}"] = value
    state |= heads("alex") | {key.replace("lin", "lins."): value for key, value in heads("alex").items()}
    state["scaling_layer.shift"] = torch.zeros(1, 3, 1, 1)
    torch.save(state, tmp_path / "whole.pt")
    (found,), _ = find_lpips(tmp_path / "whole.pt")
    a, b = images(40, 40)
    assert found.network.name == "alex" and found.distance(a, b) == both["alex"].distance(a, b)
    assert found.files == [str(tmp_path / "whole.pt")]


def test_weights_are_found_in_the_torch_cache_and_packages(tmp_path, monkeypatch, files, both):
    assert find_lpips()[0] == []
    cache = tmp_path / "torch" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    (cache / "alexnet-owt-12345678.pth").write_bytes((files / "alex_features.pth").read_bytes())
    found, missing = find_lpips()
    assert found == [] and "its linear heads (they are in the packages lpips and torchmetrics)" in missing
    package = tmp_path / "site" / "torchmetrics"
    folder = package / "functional" / "image" / "lpips_models"
    folder.mkdir(parents=True)
    for network in NETWORKS:
        (folder / f"{network}.pth").write_bytes((files / f"{network}_heads.pth").read_bytes())
    spec = importlib.machinery.ModuleSpec("torchmetrics", None, is_package=True)
    spec.submodule_search_locations = [str(package)]
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: spec if name == "torchmetrics" else None)
    (found,), missing = find_lpips()
    a, b = images(40, 40)
    assert missing == "" and found.distance(a, b) == both["alex"].distance(a, b)
    assert found.files == [str(cache / "alexnet-owt-12345678.pth"), str(folder / "alex.pth")]
    # What is given comes first, and completes what is there.
    assert [each.network.name for each in find_lpips(files / "vgg_features.pth")[0]] == ["alex", "vgg"]
    (cache / "alexnet-owt-12345678.pth").write_bytes(b"broken")
    found, missing = find_lpips()
    assert found == [] and "alexnet-owt-12345678.pth: cannot be read" in missing


def damaged(kind, files, path):
    state = torch.load(files / "alex_features.pth", weights_only=True)
    if kind == "truncated":
        path.write_bytes((files / "vgg_heads.pth").read_bytes()[:-300])
    elif kind == "truncated, old format":
        path.write_bytes((files / "alex_features.pth").read_bytes()[:-300])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("not weights")
    elif kind == "list":
        torch.save([torch.zeros(3)], path)
    elif kind == "code":
        torch.save(torch.nn.Linear(2, 2), path)
    elif kind == "another network":
        torch.save({"conv1.weight": torch.zeros(64, 3, 7, 7)}, path)
    elif kind == "shape":
        torch.save(state | {"features.3.weight": torch.zeros(192, 64, 3, 3)}, path)
    elif kind == "layer missing":
        del state["features.8.bias"]
        torch.save(state, path)
    elif kind == "NaN":
        state["features.6.bias"][7] = math.nan
        torch.save(state, path)
    elif kind == "heads of SqueezeNet":
        torch.save(
            {
                f"lin{k}.model.1.weight": torch.zeros(1, c, 1, 1)
                for k, c in enumerate((64, 128, 256, 384, 384, 512, 512))
            },
            path,
        )


REFUSED = {
    "truncated": "cannot be read",
    "truncated, old format": "cannot be read",
    "empty": "cannot be read",
    "text": "cannot be read",
    "list": "holds list with something else than tensors, wanted a table of weights",
    "code": "cannot be read",
    "another network": "holds no weights of AlexNet, VGG16 or of the heads of LPIPS, wanted one of them",
    "shape": "features.3.weight is 192x64x3x3, wanted 192x64x5x5",
    "layer missing": "lacks features.8.bias, wanted the weights of AlexNet",
    "NaN": "features.6.bias holds NaN or infinity, wanted finite weights",
    "heads of SqueezeNet": "its heads are those of neither AlexNet nor VGG16",
}


@pytest.mark.parametrize("kind", REFUSED)
def test_files_without_weights_are_refused(kind, files, tmp_path):
    path = tmp_path / "weights.pth"
    damaged(kind, files, path)
    with pytest.raises(LinprimError) as refused:
        find_lpips(path)
    assert (
        str(refused.value).startswith(f"{path}: ")
        and REFUSED[kind] in str(refused.value)
        and "\n" not in str(refused.value)
    )


def test_incomplete_weights_are_refused(files, tmp_path):
    with pytest.raises(LinprimError, match="no such file or folder, wanted the weights of LPIPS"):
        find_lpips(tmp_path / "gone.pth")
    with pytest.raises(LinprimError, match="holds no .pth and no .pt file"):
        find_lpips(tmp_path)
    with pytest.raises(LinprimError, match="is not enough, LPIPS wants its linear heads"):
        find_lpips(files / "alex_features.pth")
    with pytest.raises(LinprimError, match="is not enough, LPIPS wants torchvision's weights of AlexNet or VGG16"):
        find_lpips(files / "alex_heads.pth")
    for name in ("alex_features.pth", "vgg_heads.pth"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    with pytest.raises(LinprimError, match="wants a classifier and heads of the same network"):
        find_lpips(tmp_path)


# --- the command -----------------------------------------------------------------------------------------


def test_the_command_scores_with_weights_and_reports_missing_ones(tiny_run, files, tmp_path, capfd):
    def command(*more, status=0):
        assert cli.main(["eval-images", str(tiny_run), "-o", str(tmp_path / "out"), "--json", *more]) == status
        shown = capfd.readouterr()
        return json.loads(shown.out) if status == 0 else shown.err

    scores = command("--lpips-weights", str(files))
    names = ("lpips_alex", "lpips_vgg", "lpips_vgg_3dgs")
    with open(tmp_path / "out" / "per_view.csv", newline="") as table:
        rows = list(csv.DictReader(table))
    assert list(rows[0]) == ["name", "psnr", "ssim", *names]
    for name in names:
        values = [float(row[name]) for row in rows]
        assert scores[name] == pytest.approx(np.mean(values)) and scores[name] > 0
        assert scores[f"{name}_standard_error"] == pytest.approx(np.std(values, ddof=1) / math.sqrt(3))
    assert json.loads((tmp_path / "out" / "results.json").read_text())["lpips_vgg"] == scores["lpips_vgg"]
    assert scores["lpips_files"]["vgg"] == [str(files / "vgg_features.pth"), str(files / "vgg_heads.pth")]

    plain = command()
    assert "lpips_vgg" not in plain and plain["psnr"] == scores["psnr"]
    assert plain["lpips_missing"].startswith("LPIPS wants torchvision's weights of AlexNet or VGG16 (none in ")
    assert plain["lpips_missing"].endswith(": give them with --lpips-weights")
    with open(tmp_path / "out" / "per_view.csv", newline="") as table:
        assert list(csv.DictReader(table))[0].keys() == {"name", "psnr", "ssim"}
    assert not any("lpips" in name for name in command("--lpips-weights", "none"))
    assert "gone.pth: no such file or folder" in command("--lpips-weights", str(tmp_path / "gone.pth"), status=1)


def test_networks_skip_or_refuse_small_views(files, tmp_path):
    from linprim_geo.base.options import SceneOptions, TrainOptions
    from linprim_geo.synthetic.synth import synthesize
    from linprim_geo.training.train import train

    synthesize(tmp_path / "scene", shape="cad", views=6, test_views=2, size=(40, 24), points=200, supersample=1)
    options = TrainOptions(iterations=5, max_primitives=50, sh_degree=0, threads=1)
    train(tmp_path / "scene", tmp_path / "run", SceneOptions(), options, quiet=True)
    scores = eval_images_run(tmp_path / "run", lpips_weights=files)  # VGG16 takes them, AlexNet does not
    assert scores["lpips_vgg"] > 0 and "lpips_alex" not in scores
    (tmp_path / "alex").mkdir()
    for name in ("alex_features.pth", "alex_heads.pth"):
        (tmp_path / "alex" / name).write_bytes((files / name).read_bytes())
    with pytest.raises(LinprimError, match="is 40x24, LPIPS wants at least 31x31"):
        eval_images_run(tmp_path / "run", lpips_weights=tmp_path / "alex")
