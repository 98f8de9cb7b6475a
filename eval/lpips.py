"""LPIPS, a learned perceptual distance of two images, from weights found on this machine; nothing is downloaded.

Features after five layers of a classifier are normalized to length 1 over the channels. Their squared difference is
weighted per channel by a linear head, averaged over the image and summed over the layers. Source: Zhang et al., "The
unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018, eq. 1; version 0.1 of its weights.
"""

from __future__ import annotations

import importlib.util
import os
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from linprim_geo.base.errors import LinprimError

# Mean and standard deviation of ImageNet, the classifiers' training set, for colours in [-1, 1].
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Added to the length of a feature before the division.
EPSILON = 1e-10
SUFFIXES = (".pth", ".pt")
# Packages that contain the heads, and the folder in each.
PACKAGES = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}
_KEY = re.compile(r"(?:features|net\.slice\d+)\.(\d+)\.(weight|bias)")


@dataclass(frozen=True)
class Conv:
    """A convolution followed by a ReLU: its `index` in torchvision's `features`; `pool` is the size of the max-pooling
    of stride 2 before it, 0 for none; `tap` whether its output is compared."""

    index: int
    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0
    tap: bool = True


@dataclass(frozen=True)
class Network:
    """The convolutions of a classifier; `smallest` is the least image side, in pixels, for which the last layer is not
    empty."""

    name: str
    title: str
    convs: tuple[Conv, ...]
    smallest: int
    file: str  # name pattern of torchvision's weights in torch's cache

    @property
    def taps(self) -> list[int]:
        """The channels of the layers that are compared."""
        return [conv.channels for conv in self.convs if conv.tap]

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the weights, by torchvision's names without `features.`."""
        found, before = {}, 3
        for conv in self.convs:
            found[f"{conv.index}.weight"] = (conv.channels, before, conv.kernel, conv.kernel)
            found[f"{conv.index}.bias"] = (conv.channels,)
            before = conv.channels
        return found


NETWORKS = {
    network.name: network
    for network in (
        Network(
            "alex",
            "AlexNet",
            (Conv(0, 64, 11, 4, 2), Conv(3, 192, 5, 1, 2, pool=3), Conv(6, 384, pool=3), Conv(8, 256), Conv(10, 256)),
            31,
            "alexnet-*.pth",
        ),
        Network(
            "vgg",
            "VGG16",
            (
                Conv(0, 64, tap=False),
                Conv(2, 64),
                Conv(5, 128, pool=2, tap=False),
                Conv(7, 128),
                Conv(10, 256, pool=2, tap=False),
                Conv(12, 256, tap=False),
                Conv(14, 256),
                Conv(17, 512, pool=2, tap=False),
                Conv(19, 512, tap=False),
                Conv(21, 512),
                Conv(24, 512, pool=2, tap=False),
                Conv(26, 512, tap=False),
                Conv(28, 512),
            ),
            16,
            "vgg16-*.pth",
        ),
    )
}


class Lpips:
    """LPIPS with one network. `files` are the files of its weights."""

    def __init__(
        self,
        network: Network,
        backbone: dict[str, torch.Tensor],
        heads: Sequence[torch.Tensor],
        files: Sequence[Path] = (),
    ):
        """`backbone`: tensors by the names of `Network.shapes`; `heads`: (C,) for each layer; all float32."""
        self.network, self.backbone, self.heads, self.files = (
            network,
            backbone,
            list(heads),
            [str(file) for file in files],
        )

    @torch.no_grad()
    def distance(self, a: np.ndarray, b: np.ndarray, *, as_3dgs: bool = False) -> float:
        """Return the distance of two images (H, W, 3) of one shape, uint8 or float in [0, 1]. It is symmetric, and 0
        for equal images.

        With `as_3dgs` colours are passed in [0, 1] although the network was calibrated for [-1, 1], as in the tables of
        3DGS and LinPrim; distances come out smaller.

        Raises:
            LinprimError: the images are smaller than the network allows.
        """
        if min(a.shape[:2]) < self.network.smallest:
            least = self.network.smallest
            raise LinprimError(
                f"the image is {a.shape[1]}x{a.shape[0]}, LPIPS by {self.network.title} wants {least}x{least} at least"
            )
        x, y = (self._prepared(image, as_3dgs) for image in (a, b))
        total, layer = 0.0, 0
        for conv in self.network.convs:
            x, y = self._after(conv, x), self._after(conv, y)
            if conv.tap:
                difference = (_unit(x) - _unit(y)).square()
                total += float((difference * self.heads[layer][None, :, None, None]).sum(1).mean(dtype=torch.float64))
                layer += 1
        return total

    def _prepared(self, image: np.ndarray, as_3dgs: bool) -> torch.Tensor:
        image = image.astype(np.float32) / np.float32(255) if image.dtype == np.uint8 else image.astype(np.float32)
        values = torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0)[None]))
        values = values if as_3dgs else 2 * values - 1
        return (values - torch.tensor(SHIFT)[None, :, None, None]) / torch.tensor(SCALE)[None, :, None, None]

    def _after(self, conv: Conv, values: torch.Tensor) -> torch.Tensor:
        if conv.pool:
            values = torch.nn.functional.max_pool2d(values, conv.pool, 2)
        weight, bias = self.backbone[f"{conv.index}.weight"], self.backbone[f"{conv.index}.bias"]
        return torch.nn.functional.conv2d(values, weight, bias, conv.stride, conv.padding).relu_()


def _unit(features: torch.Tensor) -> torch.Tensor:
    return features / (torch.linalg.vector_norm(features, dim=1, keepdim=True) + EPSILON)


# --- weights -----------------------------------------------------------------------------------------------


def find_lpips(weights: str | os.PathLike | None = None) -> tuple[list[Lpips], str]:
    """Return LPIPS for every network whose weights are found, and a sentence on what is missing if there are none.

    A network needs two sets of weights: torchvision's of the classifier, and the heads. Both may be in `weights`, a
    file or a folder of `.pth` and `.pt` files of any names; one file with the whole model of the package `lpips` is
    enough. The rest is read from torch's download cache and from the installed packages `lpips` and `torchmetrics`,
    which are not imported.

    Raises:
        LinprimError: `weights` is given and is missing, damaged, of another network, or not sufficient for any.
    """
    backbones: dict[str, tuple[Path, dict]] = {}
    heads: dict[str, tuple[Path, list]] = {}
    for file in _files(weights):
        _take(file, backbones, heads)
    if weights is not None and not backbones and not heads:
        raise LinprimError(
            f"{weights}: holds no weights of AlexNet, VGG16 or of the heads of LPIPS, wanted one of them"
        )
    damaged = []
    for network in NETWORKS.values():
        for found, files in ((backbones, _downloaded(network)), (heads, _installed(network))):
            if network.name not in found and files:
                try:
                    _take(files[-1], backbones, heads)
                except LinprimError as error:
                    damaged.append(str(error))
    both = [network for network in NETWORKS.values() if network.name in backbones and network.name in heads]
    if both:
        return [
            Lpips(
                n,
                backbones[n.name][1],
                heads[n.name][1],
                dict.fromkeys((backbones[n.name][0], heads[n.name][0])),
            )
            for n in both
        ], ""
    missing = [] if backbones else [f"torchvision's weights of AlexNet or VGG16 (none in {_cache()})"]
    missing += [] if heads else ["its linear heads (they are in the packages lpips and torchmetrics)"]
    sentence = f"LPIPS wants {' and '.join(missing) or 'a classifier and heads of the same network'}"
    sentence += f" ({'; '.join(damaged)})" if damaged else ""
    if weights is not None:
        raise LinprimError(f"{weights}: is not enough, {sentence}")
    return [], f"{sentence}: give them with --lpips-weights"


def _files(weights: str | os.PathLike | None) -> list[Path]:
    if weights is None:
        return []
    path = Path(weights)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES and file.is_file())
        if not files:
            raise LinprimError(f"{path}: holds no {' and no '.join(SUFFIXES)} file, wanted the weights of LPIPS")
        return files
    if not path.is_file():
        raise LinprimError(f"{path}: no such file or folder, wanted the weights of LPIPS")
    return [path]


def _cache() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"


def _downloaded(network: Network) -> list[Path]:
    return sorted(_cache().glob(network.file))


def _installed(network: Network) -> list[Path]:
    found = []
    for package, folder in PACKAGES.items():
        spec = importlib.util.find_spec(package)
        for place in (spec.submodule_search_locations or ()) if spec else ():
            file = Path(place) / folder / f"{network.name}.pth"
            found += [file] if file.is_file() else []
    return found


def _take(file: Path, backbones: dict[str, tuple[Path, dict]], heads: dict[str, tuple[Path, list]]) -> None:
    """Add the weights in a file to `backbones` and `heads`; add nothing if it holds other tensors.

    Raises:
        LinprimError: it is not a file of weights, or a tensor is missing, of another shape, or not finite.
    """
    state = _read(file)
    convs = {f"{m[1]}.{m[2]}": value for key, value in state.items() if (m := _KEY.fullmatch(key))}
    first = convs.get("0.weight")
    for network in NETWORKS.values():
        shapes = network.shapes()
        if first is not None and tuple(first.shape) == shapes["0.weight"]:
            backbone = {
                name: _checked(file, f"features.{name}", convs.get(name), shape) for name, shape in shapes.items()
            }
            backbones.setdefault(network.name, (file, backbone))
    found = [state.get(f"lin{k}.model.1.weight") for k in range(len(NETWORKS["vgg"].taps))]
    if found[0] is None:
        return
    fitting = [
        n for n in NETWORKS.values() if all(v is None or v.numel() == c for v, c in zip(found, n.taps, strict=True))
    ]
    network = fitting[0] if fitting and f"lin{len(found)}.model.1.weight" not in state else None
    if network is None:
        raise LinprimError(f"{file}: its heads are those of neither AlexNet nor VGG16, wanted alex.pth or vgg.pth")
    taken = [
        _checked(file, f"lin{k}.model.1.weight", v, (1, c, 1, 1))
        for k, (v, c) in enumerate(zip(found, network.taps, strict=True))
    ]
    heads.setdefault(network.name, (file, [head.reshape(-1) for head in taken]))


def _read(file: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of a file, without executing code from it."""
    try:
        # Memory mapping avoids reading the classifier's last layers, the largest and unused part. Only files that are
        # archives can be mapped.
        state = torch.load(file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file))
    except Exception as error:  # torch raises nearly any exception for a file that is not its own
        reason = " ".join(str(error).split()).split(". ")[0][:120] or type(error).__name__
        raise LinprimError(f"{file}: cannot be read ({reason}), wanted weights that PyTorch has saved") from None
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise LinprimError(
            f"{file}: holds {type(state).__name__} with something else than tensors, wanted a table of weights"
        )
    return state


def _checked(file: Path, name: str, value: torch.Tensor | None, shape: tuple[int, ...]) -> torch.Tensor:
    if value is None:
        raise LinprimError(f"{file}: lacks {name}, wanted the weights of AlexNet or VGG16 and heads of five layers")
    if tuple(value.shape) != shape:
        raise LinprimError(f"{file}: {name} is {'x'.join(map(str, value.shape))}, wanted {'x'.join(map(str, shape))}")
    value = value.float()
    if not bool(torch.isfinite(value).all()):
        raise LinprimError(f"{file}: {name} holds NaN or infinity, wanted finite weights")
    return value
