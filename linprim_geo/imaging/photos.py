"""Decoding of photographs, masks and depth maps, their downscaling, and an on-disk cache of undistorted photographs."""

from __future__ import annotations

import hashlib
import os
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from linprim_geo.base.arrays import read_array
from linprim_geo.base.errors import LinprimError
from linprim_geo.base.files import atomic_write
from linprim_geo.geometry.lens import Intrinsics, Lens, source_pixels
from linprim_geo.geometry.sampling import sample_bilinear, sample_nearest

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_MODES_WITH_ALPHA = ("RGBA", "LA", "PA", "La", "RGBa")
# Largest ratio of neighbouring depths of one surface, when four depths are averaged.
_SAME_SURFACE_RATIO = 1.05
# Incremented whenever undistortion gives other pixels, so that old cache entries are not used.
_CACHE_VERSION = 1


def cache_folder(cache: str | os.PathLike | None = None) -> Path:
    """Return the folder for cached results: `cache`, else $LINPRIM_GEO_CACHE, else ~/.cache/linprim-geo."""
    if cache:
        return Path(cache)
    return Path(os.environ.get("LINPRIM_GEO_CACHE") or Path.home() / ".cache" / "linprim-geo")


def files_in(folder: Path) -> list[Path]:
    """Return the images directly in a folder, sorted by name; none if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(
        path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    )


@contextmanager
def _opened(path: Path):
    """Open a PIL image; convert all errors while it is open to a LinprimError."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            yield image
    except FileNotFoundError as error:
        raise LinprimError(f"{path}: no such file, wanted an image") from error
    except Image.DecompressionBombError as error:
        raise LinprimError(f"{path}: {error}") from error
    except LinprimError:
        raise
    except Exception as error:  # Pillow raises a dozen kinds for damaged files
        if isinstance(error, PermissionError):
            reason = "no permission to read it"
        elif isinstance(error, MemoryError):
            reason = "its pixels take more memory than there is"
        elif path.is_file() and path.stat().st_size == 0:
            reason = "the file is empty"
        elif isinstance(error, Image.UnidentifiedImageError):
            reason = "not an image in a known format"
        else:
            reason = str(error).splitlines()[0] if str(error) else "damaged"
        raise LinprimError(
            f"{path}: cannot be read as an image ({reason}), wanted a complete PNG, JPEG or the like"
        ) from error


def image_header(path: Path) -> tuple[int, int, bool]:
    """Return (width, height, whether there is an alpha channel), from the header alone.

    Raises:
        LinprimError: the file is missing, empty, or not an image.
    """
    with _opened(path) as image:
        return image.width, image.height, _has_alpha(image)


def image_format(path: Path) -> str:
    """Return Pillow's name of the file's actual format, whatever its suffix: PNG, JPEG, MPO, WEBP, TIFF, BMP or
    another.

    Raises:
        LinprimError: the file is missing, empty, or not an image.
    """
    with _opened(path) as image:
        return image.format


def fits(path: Path, size: tuple[int, int]) -> bool:
    """Return whether the image has `size` (width, height) as stored, or after the rotation in its EXIF data."""
    with _opened(path) as image:
        return image.size == size or (image.size == size[::-1] and _is_turned(image))


def read_photo(path: Path, size: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode to ((H, W, 3) uint8 straight colours, (H, W) uint8 alpha or None); 16-bit files lose their low
    byte.

    Raises:
        LinprimError: the file is unreadable or truncated, or not of `size` (width, height).
    """
    from PIL import ImageOps

    with _opened(path) as image:
        if size is not None and image.size == size[::-1] != size and _is_turned(image):
            image = ImageOps.exif_transpose(image)
        if size is not None and image.size != size:
            raise LinprimError(
                f"{path}: the image is {image.width}x{image.height}, wanted {size[0]}x{size[1]} as its camera says"
            )
        if image.mode.startswith("I") or image.mode == "F":
            grey = _to_byte(np.asarray(image))
            return np.repeat(grey[..., None], 3, axis=2), None
        if _has_alpha(image):
            pixels = np.asarray(image.convert("RGBA"))
            return np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
        return np.array(image.convert("RGB")), None


def read_mask(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return the (H, W) uint8 foreground mask: the alpha channel if it is not opaque everywhere, else the brightest
    channel.

    In files that hold only 0 and 1, 1 becomes 255.

    Raises:
        LinprimError: the file is unreadable, or not of `size` (width, height).
    """
    width, height, _ = image_header(path)
    if (width, height) != size:  # checked before decompression
        raise LinprimError(f"{path}: the mask is {width}x{height}, wanted {size[0]}x{size[1]} as its image")
    rgb, alpha = read_photo(path, None)
    grey = rgb.max(axis=2)
    if alpha is not None and alpha.min() < 255:
        grey = alpha
    return grey * np.uint8(255) if grey.max() == 1 else grey


def read_depth(path: Path, scale: float, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W) float32 z-depth in the data set's unit: stored values times `scale`; 0 where there is none.

    Reads 16-bit PNG or TIFF, .npy and .npz (the only or the first array).

    Raises:
        LinprimError: the file is unreadable, does not hold one number per pixel, has 8 bits, or is not of `size`
            (width, height).
    """
    if not path.is_file():
        raise LinprimError(f"{path}: no such file, wanted a depth map")

    def check(shape: tuple[int, ...], dtype: np.dtype) -> None:
        held = tuple(length for length in shape if length != 1)
        if len(held) != 2 or dtype.kind not in "uif":
            raise LinprimError(f"{path}: the depth map has shape {shape} of {dtype}, wanted one number per pixel")
        if held != size[::-1]:
            raise LinprimError(f"{path}: the depth map is {held[1]}x{held[0]}, wanted {size[0]}x{size[1]} as its image")

    if path.suffix in (".npy", ".npz"):
        try:
            values = np.squeeze(read_array(path, check))
        except LinprimError:
            raise
        except Exception as error:  # numpy and zipfile raise a dozen kinds for damaged files
            raise LinprimError(
                f"{path}: cannot be read as a depth map ({error}), wanted a complete .npy or .npz"
            ) from error
    else:
        with _opened(path) as image:
            check(image.size[::-1], np.dtype(np.float32))  # before decompression
            values = np.asarray(image)
        if values.dtype == np.uint8:
            raise LinprimError(f"{path}: the depth map has {image.mode} pixels of 8 bits, wanted 16-bit grey or float")
        check(values.shape, values.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (values.astype(np.float64) * scale).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def box_downscale(rgb: np.ndarray, alpha: np.ndarray | None, factor: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Average blocks of factor x factor pixels, colours weighted by alpha; incomplete rows and columns of blocks are
    cropped.

    The stored values are averaged. The colour of a fully transparent block is the unweighted mean.
    """
    if factor == 1:
        return rgb, alpha
    blocks = _blocks(rgb, factor).astype(np.float32)
    plain = blocks.mean(axis=(1, 3))
    if alpha is None:
        return _round(plain), None
    weight = _blocks(alpha[..., None], factor).astype(np.float32)
    total = weight.sum(axis=(1, 3))
    weighted = (blocks * weight).sum(axis=(1, 3)) / np.maximum(total, 1.0)
    return _round(np.where(total > 0, weighted, plain)), _round(total[..., 0] / factor**2)


def read_normals(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W, 3) float32 unit normals as stored, without a change of axes; 0 where there is none.

    Reads 8-bit images, in which a byte b means 2 b / 255 - 1 and black means no normal, and .npy of three numbers per
    pixel.

    Raises:
        LinprimError: the file is unreadable, does not hold three numbers per pixel, or is not of `size`
            (width, height).
    """
    if not path.is_file():
        raise LinprimError(f"{path}: no such file, wanted normals")

    def check(shape: tuple[int, ...], dtype: np.dtype) -> None:
        if dtype.kind not in "uif":
            raise LinprimError(f"{path}: the normals are of the type {dtype}, wanted three numbers per pixel")
        if shape != (size[1], size[0], 3):
            raise LinprimError(f"{path}: the normals have shape {shape}, wanted {(size[1], size[0], 3)}")

    if path.suffix == ".npy":
        try:
            values = read_array(path, check)
        except LinprimError:
            raise
        except Exception as error:  # numpy raises half a dozen kinds for damaged files
            raise LinprimError(f"{path}: cannot be read as normals ({error}), wanted a complete .npy") from error
        with np.errstate(over="ignore"):
            normals = values.astype(np.float32)
    else:
        with _opened(path) as image:
            check((image.height, image.width, 3), np.dtype(np.uint8))  # before decompression
            values = np.asarray(image.convert("RGB"))
        normals = np.where(values.any(-1, keepdims=True), values.astype(np.float32) * (2 / 255) - 1, np.float32(0))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > 0.5)
    return np.divide(normals, length, out=np.zeros_like(normals, np.float32), where=usable)


def downscale_depth(depth: np.ndarray, factor: int) -> np.ndarray:
    """Return (H // factor, W // factor) float32 depth at the new pixel centres.

    An odd factor selects the pixel there. With an even one, the new centre is the common corner of four pixels. If the
    four are on one surface, their inverse depths are averaged, which is exact on planes; otherwise there is no depth.
    """
    if factor == 1:
        return depth
    blocks = _blocks(depth[..., None], factor)[..., 0]
    if factor % 2:
        return np.ascontiguousarray(blocks[:, factor // 2, :, factor // 2])
    low, high = factor // 2 - 1, factor // 2
    four = np.stack([blocks[:, i, :, j] for i in (low, high) for j in (low, high)]).astype(np.float64)
    nearest, farthest = four.min(axis=0), four.max(axis=0)
    one_surface = (nearest > 0) & (farthest <= nearest * _SAME_SURFACE_RATIO)
    with np.errstate(divide="ignore"):
        mean = 4.0 / (1.0 / four).sum(axis=0)
    return np.where(one_surface, mean, 0.0).astype(np.float32)


def undistort_photo(rgb: np.ndarray, alpha: np.ndarray | None, lens: Lens, target: Intrinsics):
    """Resample (bilinear, colours weighted by alpha) a photograph of `lens` to the pinhole camera `target`."""
    pixels = source_pixels(lens, target)
    if alpha is None:
        return _round(sample_bilinear(rgb, pixels)), None
    weight = alpha[..., None].astype(np.float32) / 255.0
    out = sample_bilinear(np.concatenate([rgb * weight, rgb, weight], axis=2), pixels)
    opacity = out[..., 6:]
    straight = np.where(opacity > 0, out[..., :3] / np.maximum(opacity, 1e-6), out[..., 3:6])  # 1e-6: far below 1/255
    return _round(straight), _round(opacity[..., 0] * 255.0)


def undistort_depth(depth: np.ndarray, lens: Lens, target: Intrinsics) -> np.ndarray:
    """Resample (nearest) a depth map of `lens` to the pinhole camera `target`; z is unchanged, as the optical axis is
    the same."""
    return sample_nearest(depth, source_pixels(lens, target))


class UndistortedCache:
    """Undistorted photographs as PNG files in `folder`, identified by a hash of the content of their sources."""

    def __init__(self, folder: Path, lens: Lens, target: Intrinsics, sources: tuple[Path | None, ...], flavour: str):
        digest = hashlib.blake2b(repr((_CACHE_VERSION, lens, target, flavour)).encode(), digest_size=16)
        for source in sources:
            if source is not None:
                try:
                    content = source.read_bytes()
                except OSError as error:
                    raise LinprimError(f"{source}: cannot be read ({error.strerror}), wanted an image") from error
                digest.update(len(content).to_bytes(8, "little"))
                digest.update(content)
        self.path = folder / "undistorted" / digest.hexdigest()[:2] / f"{digest.hexdigest()}.png"
        self.size = (target.width, target.height)

    def get(self) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return the stored photograph, or None if there is no usable one."""
        if not self.path.is_file():
            return None
        try:
            return read_photo(self.path, self.size)
        except LinprimError:
            return None

    def put(self, rgb: np.ndarray, alpha: np.ndarray | None) -> None:
        """Store the photograph. An unwritable cache is no error: the photograph is then undistorted again next time."""
        from PIL import Image

        pixels = rgb if alpha is None else np.concatenate([rgb, alpha[..., None]], axis=2)
        try:
            with atomic_write(self.path) as temporary:
                Image.fromarray(pixels).save(temporary, format="PNG", compress_level=1)
        except (LinprimError, OSError):
            pass


def _has_alpha(image) -> bool:
    return image.mode in _MODES_WITH_ALPHA or "transparency" in image.info


def _is_turned(image) -> bool:
    """Return whether EXIF demands that rows and columns are exchanged (orientations 5 to 8)."""
    orientation_tag = 0x0112
    return image.getexif().get(orientation_tag, 1) in (5, 6, 7, 8)


def _to_byte(values: np.ndarray) -> np.ndarray:
    """Convert grey of more than 8 bits to uint8: the high byte of 16 bits, floats as [0, 1]."""
    if values.dtype.kind == "f":
        return _round(np.clip(np.nan_to_num(values), 0.0, 1.0) * 255.0)
    return (np.clip(values, 0, 65535).astype(np.uint16) >> 8).astype(np.uint8)


def _blocks(image: np.ndarray, factor: int) -> np.ndarray:
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image[: height * factor, : width * factor].reshape(height, factor, width, factor, image.shape[2])


def _round(values: np.ndarray) -> np.ndarray:
    return np.clip(values + 0.5, 0.0, 255.0).astype(np.uint8)
