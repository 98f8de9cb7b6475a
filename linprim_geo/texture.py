"""Textures of extracted meshes: flat charts packed into a square image, baked from the photographs that see each texel.

Charts are grown over faces that look along the same axis and are projected onto a plane, so that any mesh has them, in
seconds: open, closed, or with edges of many faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .errors import LinprimError
from .files import atomic_write
from .mesh import Mesh, face_areas, face_normals, needs_double, validate_mesh, write_rows
from .mesh_process import paired_edges
from .visibility import POOR_RINGS, color_vertices, photographed

if TYPE_CHECKING:
    from .scene import View

TEXTURED_SUFFIXES = (".obj", ".glb")
SMALLEST, LARGEST = 16, 8192

# Free texels on each side of a chart; with those of its neighbour twice as many lie between two charts.
PADDING = 2
# Texels up to this far from a face belong to it: all that bilinear sampling of a point of the face can touch.
RING = 1.5
# A face is projected along an axis only if the cosine between it and the axis is at least this.
LEAST_COSINE = 0.4
# What a neighbour in the same chart is worth against the cosine, and how often faces choose again.
COHERENCE, ROUNDS = 1.0, 24
# A texel is covered by two faces of a chart if it lies inside both by more than rounding (barycentric coordinates).
INSIDE = 1e-6
# Candidates of (texel, face) that are looked at, and texels that are baked, at a time: some 0.4 GB.
CANDIDATES, TEXELS_PER_PASS = 2**21, 2**20
# Photographs that are kept decoded between passes.
KEPT_BYTES = 2**30
# With fewer texels per face than this, `make_texture` says so.
FEWEST_TEXELS = 4


@dataclass(frozen=True)
class Texture:
    """An image over a mesh. `image` (S, S, 3) uint8 sRGB, row 0 on top; `uv` (F, 3, 2) float64 per face and corner in
    [0, 1], v up from the lower edge of the image, as in OBJ. `about` holds what `stats.json` says of it."""

    image: np.ndarray
    uv: np.ndarray
    about: dict

    def select(self, faces: np.ndarray) -> Texture:
        """The same image over some of the faces (a mask or indices), as `select_faces` of the mesh."""
        return Texture(self.image, self.uv[faces], self.about)


def check_texture(size: int, path: Path) -> None:
    """Raises LinprimError for a size or a file format that cannot be used."""
    if not SMALLEST <= size <= LARGEST:
        raise LinprimError(f"--texture is {size}, wanted {SMALLEST} to {LARGEST} texels, or 0 for none")
    _check_suffix(path)


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in TEXTURED_SUFFIXES:
        raise LinprimError(
            f"{path}: {path.suffix} files hold no texture, wanted {' or '.join(TEXTURED_SUFFIXES)} with --texture"
        )


def make_texture(mesh: Mesh, size: int, views: Sequence[View], note: Callable[[str], None] | None = None) -> Texture:
    """Charts of a mesh and their colours out of photographs.

    Each texel has a point of the surface; its colour is the robust mean of the views that see it
    (`visibility.photographed`), so that highlights, exposure and things in the way do not show. What no view sees has
    the colours of the mesh's vertices, which are taken from the photographs if it has none. Texels between charts have
    the colour of the nearest one in a chart, so that mip-maps do not bleed. The same input gives the same texture to
    the last bit, whatever the number of threads.

    Args:
        size: texels along an edge of the image.
        views: `scene.View`s, or anything with a `camera` and a `load()` that gives `rgb` (H, W, 3) uint8 and `alpha`
            (H, W) uint8 or None. They are decoded once if they take at most KEPT_BYTES in all, else again for every
            TEXELS_PER_PASS texels.
        note: called with lines for the user.
    Raises:
        LinprimError: an empty mesh or one that is not finite, or so many charts that they do not fit.
    """
    corners, charts = unwrap(mesh, size)
    owner = _rasterize(corners, size)
    rows = np.flatnonzero(owner >= 0)
    density = len(rows) / len(mesh.faces)
    if note:
        note(
            f"texture: {charts} charts of {len(mesh.faces)} faces, {100 * len(rows) / size**2:.0f} % of "
            f"{size}x{size} texels"
        )
        if density < FEWEST_TEXELS:
            note(f"texture: {density:.1f} texels per face show little more than vertex colours, see --target-faces")
    image, seen, well = _bake(mesh, corners, owner, rows, size, _Photographs(views))
    uv = np.stack([corners[..., 0] / size, 1.0 - corners[..., 1] / size], axis=2)
    about = {
        "size": size,
        "charts": charts,
        "texels": len(rows),
        "texels_seen": float(seen),
        "texels_seen_well": float(well),
        "texel_size": _texel_size(mesh, corners),
    }
    return Texture(image, uv, about)


class _Photographs:
    """The photographs of views, (H, W, 3) uint8 or with alpha (H, W, 4), in order; decoded once if they fit into
    KEPT_BYTES."""

    def __init__(self, views: Sequence[View]):
        self.views, self.cameras = views, [view.camera for view in views]
        size = sum(4 * camera.width * camera.height for camera in self.cameras)
        self.kept = list(self._load()) if size <= KEPT_BYTES else None

    def __iter__(self):
        return iter(self.kept) if self.kept is not None else self._load()

    def _load(self):
        for view in self.views:
            photo = view.load()
            yield photo.rgb if photo.alpha is None else np.dstack([photo.rgb, photo.alpha])


def _texel_size(mesh: Mesh, corners: np.ndarray) -> float:
    """Edge of a texel on the surface, in the mesh's unit."""
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    covered = 0.5 * np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum()
    return float(np.sqrt(face_areas(mesh).sum() / covered))


# --- charts ----------------------------------------------------------------------------------------------


def unwrap(mesh: Mesh, size: int) -> tuple[np.ndarray, int]:
    """Flattens a mesh into the square.

    Returns:
        (F, 3, 2) float64 place of each corner in texels, x right and y down, no texel centre inside two faces; and the
        number of charts.
    Raises:
        LinprimError: an empty mesh or one that is not finite, or so many charts that they do not fit.
    """
    validate_mesh(mesh)
    if not np.isfinite(mesh.vertices).all():
        raise LinprimError(f"vertex {int(np.argmin(np.isfinite(mesh.vertices).all(1)))} of the mesh is not finite")
    points = (mesh.vertices - mesh.bounds.mean(0)) / mesh.diagonal
    normals, pairs = face_normals(mesh), np.stack(paired_edges(mesh.faces), axis=1) // 3
    axis = _facing_axes(normals, pairs)
    chart = _components(axis, pairs)
    suspects = np.ones(len(axis), dtype=bool)
    while True:
        flat = _flatten(points[mesh.faces], normals, axis, chart)
        corners = _pack(flat, chart, size)
        rows = np.flatnonzero(suspects)
        crossing = rows[_crossing(corners[rows], size)]
        if len(crossing) == 0:
            return corners, int(chart.max()) + 1
        label, changed = _split(points[mesh.faces].mean(1), axis, chart, crossing)
        chart = _components(label, pairs)
        suspects = changed


def _facing_axes(normals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """(F,) axis of each face: 0 to 2 for +x, +y, +z and 3 to 5 for the opposite ones, mostly the same among
    neighbours."""
    cosine = np.concatenate([normals, -normals], axis=1)
    # The best of six is at least 1 / sqrt(3), so a face with a normal always has a choice.
    allowed = (cosine >= LEAST_COSINE) | ~np.any(normals, axis=1)[:, None]
    label = np.argmax(cosine, axis=1)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    for _ in range(ROUNDS):
        votes = np.bincount(ends[:, 0] * 6 + label[ends[:, 1]], minlength=6 * len(label)).reshape(-1, 6)
        chosen = np.argmax(np.where(allowed, cosine + COHERENCE / 3.0 * votes, -np.inf), axis=1)
        if np.array_equal(chosen, label):
            break
        label = chosen
    return label


def _components(label: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """(F,) number of the chart of each face: neighbours with the same label are in one."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    one, other = pairs[label[pairs[:, 0]] == label[pairs[:, 1]]].T
    graph = coo_matrix((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(label), len(label)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _split(
    centers: np.ndarray, axis: np.ndarray, chart: np.ndarray, crossing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Labels that take the `crossing` faces, which hide each other, out of their charts; and which faces are in such a
    chart.

    A chart that is nothing else is cut in two at the middle of its faces by height.
    """
    count = int(chart.max()) + 1
    inside = np.zeros(len(chart), dtype=bool)
    inside[crossing] = True
    number = np.bincount(chart[crossing], minlength=count)
    whole = (number == np.bincount(chart, minlength=count))[chart]
    label = 2 * chart + (inside & ~whole)
    rows = np.flatnonzero(whole)
    if len(rows):
        height = np.take_along_axis(centers[rows], (axis[rows] % 3)[:, None], axis=1)[:, 0]
        order = np.lexsort((height, chart[rows]))
        _, first, faces = np.unique(chart[rows][order], return_index=True, return_counts=True)
        rank = np.arange(len(rows)) - np.repeat(first, faces)
        label[rows[order]] += rank >= np.repeat(faces // 2, faces)
    return label, (number > 0)[chart]


def _flatten(corners: np.ndarray, normals: np.ndarray, axis: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """(F, 3, 2) corners of each face in the plane of its chart, least coordinates of a chart 0, turned to lie in a
    small box.

    The plane is across the mean normal of the chart if all its faces look along that, else across its axis.
    """
    count = int(chart.max()) + 1
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(edge, other)
    mean = np.stack([np.bincount(chart, cross[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.divide(mean, length, out=np.zeros_like(mean), where=length > 0)
    least = np.ones(count)
    cosine = np.einsum("fk,fk->f", normals, mean[chart])
    np.minimum.at(least, chart[normals.any(1)], cosine[normals.any(1)])
    first = np.zeros(count, dtype=np.int64)
    first[chart[::-1]] = np.arange(len(chart))[::-1]
    along = np.concatenate([np.eye(3), -np.eye(3)])[axis[first]]
    direction = np.where(((least >= LEAST_COSINE) & (length[:, 0] > 0))[:, None], mean, along)
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    right = np.cross(helper, direction)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(direction, right)
    flat = np.stack([np.einsum("fkc,fc->fk", corners, side[chart]) for side in (right, down)], axis=2)

    # Along the principal axes of the corners, if that box is smaller.
    owner = np.repeat(chart, 3)
    size = np.maximum(np.bincount(owner, minlength=count), 1)
    x, y = (flat[..., k].ravel() for k in range(2))
    x = x - (np.bincount(owner, x, count) / size)[owner]
    y = y - (np.bincount(owner, y, count) / size)[owner]
    xx, yy, xy = (np.bincount(owner, value, count) for value in (x * x, y * y, x * y))
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    c, s = np.cos(angle)[owner], np.sin(angle)[owner]
    turned = np.stack([c * x + s * y, c * y - s * x], axis=1)
    plain = np.stack([x, y], axis=1)
    box, box_turned = _boxes(plain, owner, count), _boxes(turned, owner, count)
    better = np.prod(box_turned[1] - box_turned[0], axis=1) < np.prod(box[1] - box[0], axis=1)
    flat = np.where(better[owner, None], turned, plain)
    low, high = _boxes(flat, owner, count)
    flat = flat - low[owner]
    upright = (high - low)[:, 1] > (high - low)[:, 0]
    flat = np.where(upright[owner, None], flat[:, ::-1], flat)
    return flat.reshape(-1, 3, 2)


def _boxes(points: np.ndarray, owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, owner, points)
    np.maximum.at(high, owner, points)
    return low, high


def _pack(flat: np.ndarray, chart: np.ndarray, size: int) -> np.ndarray:
    """Places charts on shelves, at the largest scale at which they fit: (F, 3, 2) corners in texels.

    Raises:
        LinprimError: they do not fit however small.
    """
    count = int(chart.max()) + 1
    extent = _boxes(flat.reshape(-1, 2), np.repeat(chart, 3), count)[1]
    low, place = 0.0, _shelves(np.zeros_like(extent), size)
    if place is None:
        raise LinprimError(
            f"the {count} charts of {len(chart)} faces do not fit into a texture of {size}x{size} texels: "
            "wanted a larger --texture, or fewer faces by --target-faces"
        )
    area = float(np.prod(extent, axis=1).sum())
    high = size / np.sqrt(area) if area > 0 else float(size)
    for _ in range(24):
        middle = 0.5 * (low + high)
        trial = _shelves(extent * middle, size)
        if trial is None:
            high = middle
        else:
            low, place = middle, trial
    return flat * low + place[chart][:, None, :] + (PADDING + 0.5)


def _shelves(extent: np.ndarray, size: int) -> np.ndarray | None:
    """(C, 2) whole texels at which boxes with a padding start, tallest first from left to right; None if they do not
    fit."""
    boxes = np.ceil(extent).astype(np.int64) + 1 + 2 * PADDING
    if boxes.max() > size or boxes.prod(1).sum() > size**2:
        return None
    order = np.lexsort((-boxes[:, 0], -boxes[:, 1]))
    place = np.empty((len(boxes), 2), dtype=np.int64)
    x = y = shelf = 0
    for k, (width, height) in zip(order.tolist(), boxes[order].tolist(), strict=True):
        if x + width > size:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, height)
        if y + height > size:
            return None
        place[k] = x, y
        x += width
    return place


# --- texels ----------------------------------------------------------------------------------------------


def _crossing(corners: np.ndarray, size: int) -> np.ndarray:
    """Faces that have a texel centre inside which lies inside another face too."""
    owner = np.full(size * size, -1, dtype=np.int64)
    found = []
    for texel, face, points in _candidates(corners, size, 0.0):
        inner = _weights(points, corners[face]).min(1) > INSIDE
        texel, face = texel[inner], face[inner]
        before = owner[texel]
        owner[texel] = face
        # Where a face is not the last one of this run to be written it has met another.
        found += [
            face[before >= 0],
            before[before >= 0],
            face[owner[texel] != face],
            owner[texel][owner[texel] != face],
        ]
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *found]))


def _rasterize(corners: np.ndarray, size: int) -> np.ndarray:
    """(size * size,) int32 face that each texel centre belongs to: one that it lies in, else the nearest within RING,
    else -1."""
    owner = np.full(size * size, -1, dtype=np.int32)
    for texel, face, points in _candidates(corners, size, 0.0):
        inner = _weights(points, corners[face]).min(1) >= 0
        # The last of equal indices is what stays, so the order of faces decides on an edge that two share.
        owner[texel[inner][::-1]] = face[inner][::-1]
    taken = owner >= 0
    gap = np.full(size * size, np.inf, dtype=np.float32)
    for texel, face, points in _candidates(corners, size, RING):
        free = ~taken[texel]
        texel, face = texel[free], face[free]
        distance = _nearest_in(points[free], corners[face])[1].astype(np.float32)
        near = distance <= RING
        texel, face, distance = texel[near], face[near], distance[near]
        order = np.lexsort((face, distance, texel))
        texel, face, distance = texel[order], face[order], distance[order]
        better = distance < gap[texel]
        better[1:] &= texel[1:] != texel[:-1]
        owner[texel[better]], gap[texel[better]] = face[better], distance[better]
    return owner


def _candidates(corners: np.ndarray, size: int, margin: float):
    """Texels whose centres are in the boxes around faces, widened by `margin`, some at a time: texel, face, and centre
    (N, 2)."""
    low = np.maximum(np.ceil(corners.min(1) - margin - 0.5).astype(np.int64), 0)
    high = np.minimum(np.floor(corners.max(1) + margin - 0.5).astype(np.int64), size - 1)
    wide, tall = np.maximum(high - low + 1, 0).T
    for faces in _runs(wide * tall, CANDIDATES):
        each = wide[faces] * tall[faces]
        face = np.repeat(np.arange(faces.start, faces.stop), each)
        number = np.arange(len(face)) - np.repeat(np.cumsum(each) - each, each)
        x, y = low[face, 0] + number % wide[face], low[face, 1] + number // wide[face]
        yield y * size + x, face, np.stack([x, y], axis=1) + 0.5


def _runs(weights: np.ndarray, limit: int) -> list[slice]:
    """Consecutive rows that weigh no more than `limit` together, or are one row."""
    ends, total = [], np.cumsum(weights)
    start = 0
    while start < len(weights):
        before = total[start - 1] if start else 0
        stop = max(int(np.searchsorted(total, before + limit, side="right")), start + 1)
        ends.append(slice(start, stop))
        start = stop
    return ends


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def _weights(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric weights (N, 3) of points (N, 2) in triangles (N, 3, 2); all -1 in one without area."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = _cross(ab, ac)
    safe = np.where(area != 0, area, 1.0)
    v, w = _cross(points - a, ac) / safe, _cross(ab, points - a) / safe
    weights = np.stack([1.0 - v - w, v, w], axis=1)
    weights[area == 0] = -1.0
    return weights


def _nearest_in(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric weights (N, 3) of the points of triangles (N, 3, 2) nearest to points (N, 2), and the distances
    (N,)."""
    weights = _weights(points, corners)
    distance = np.zeros(len(points))
    rows = np.flatnonzero(weights.min(1) < 0)
    least = np.full(len(rows), np.inf)
    for k in range(3):
        one, edge = corners[rows, k], corners[rows, (k + 1) % 3] - corners[rows, k]
        square = (edge * edge).sum(1)
        share = np.clip(((points[rows] - one) * edge).sum(1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
        away = np.linalg.norm(points[rows] - one - share[:, None] * edge, axis=1)
        closer = away < least
        least[closer] = away[closer]
        turned = np.zeros((int(closer.sum()), 3))
        turned[:, k], turned[:, (k + 1) % 3] = 1.0 - share[closer], share[closer]
        weights[rows[closer]] = turned
    distance[rows] = least
    return weights, distance


# --- baking ----------------------------------------------------------------------------------------------


def _bake(mesh, corners, owner, rows, size, photographs):
    """The image, and the shares of its texels that some view sees, and sees well."""
    from scipy.ndimage import distance_transform_edt
    from scipy.spatial import cKDTree

    from .raycast import RayCaster

    cameras = photographs.cameras
    caster = RayCaster(mesh.vertices, mesh.faces)
    normals = face_normals(mesh)
    color = np.empty((len(rows), 3), dtype=np.float32)
    points = np.empty((len(rows), 3))
    good, seen = np.zeros(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    behind = None
    for start in range(0, len(rows), TEXELS_PER_PASS):
        part = slice(start, start + TEXELS_PER_PASS)
        texel, face = rows[part], owner[rows[part]]
        weights = _nearest_in(np.stack([texel % size, texel // size], axis=1) + 0.5, corners[face])[0]
        points[part] = np.einsum("pk,pkc->pc", weights, mesh.vertices[mesh.faces[face]])
        color[part], good[part], seen[part] = photographed(caster, points[part], normals[face], cameras, photographs)
        hidden = ~seen[part]
        if hidden.any():
            if behind is None:
                behind = mesh.colors
            if behind is None:
                behind = color_vertices(mesh, cameras, photographs)
            shades = behind[mesh.faces[face[hidden]]].astype(np.float64)
            color[np.arange(len(rows))[part][hidden]] = np.einsum("pk,pkc->pc", weights[hidden], shades)
    # The colour of a texel that is only ever seen on an outline is a mixture: the next one that is seen well has a
    # better one.
    poor = np.flatnonzero(seen & ~good)
    if len(poor) and good.any():
        middle = mesh.bounds.mean(0)
        footprint = np.median([np.linalg.norm(c.center - middle) / min(c.fx, c.fy) for c in cameras])
        known = np.flatnonzero(good)
        distance, index = cKDTree(points[known]).query(points[poor], distance_upper_bound=POOR_RINGS * footprint)
        near = np.isfinite(distance)
        color[poor[near]] = color[known[index[near]]]
    image = np.zeros((size * size, 3), dtype=np.uint8)
    image[rows] = np.clip(np.round(color), 0, 255)
    image = image.reshape(size, size, 3)
    outside = (owner < 0).reshape(size, size)
    if outside.any():
        i, j = distance_transform_edt(outside, return_distances=False, return_indices=True)
        image[outside] = image[i[outside], j[outside]]
    return image, seen.mean(), good.mean()


# --- files -----------------------------------------------------------------------------------------------


def save_textured(path: str | Path, mesh: Mesh, texture: Texture) -> None:
    """Writes a mesh with its texture: .obj with an .mtl and a .png of the same name beside it, or .glb with the image
    inside.

    Coordinates are as `save_mesh` writes them; colours and quality of the vertices are left out.

    Raises:
        LinprimError: another suffix, an empty mesh, or a folder that cannot be written.
    """
    path = Path(path)
    _check_suffix(path)
    if len(mesh.faces) == 0:
        raise LinprimError(f"{path}: the mesh has no faces, nothing is written")
    from PIL import Image

    picture = Image.fromarray(texture.image)
    if path.suffix.lower() == ".glb":
        with atomic_write(path) as temporary:
            temporary.write_bytes(_glb(mesh, texture, picture))
        return
    with atomic_write(path.with_suffix(".png")) as temporary:
        picture.save(temporary)
    with atomic_write(path.with_suffix(".mtl")) as temporary:
        temporary.write_text(
            f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {path.with_suffix('.png').name}\n",
            encoding="utf-8",
        )
    with atomic_write(path) as temporary:
        _write_obj(temporary, mesh, texture, path.with_suffix(".mtl").name)


def _seams(mesh: Mesh, texture: Texture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex and uv of each different (vertex, uv), and the (F, 3) of them that each face uses."""
    uv = np.ascontiguousarray(texture.uv.reshape(-1, 2))
    key = np.column_stack([mesh.faces.ravel(), uv.view(np.int64)])
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return mesh.faces.ravel()[first], uv[first], index.reshape(-1, 3)


def _write_obj(path: Path, mesh: Mesh, texture: Texture, material: str) -> None:
    digits = "%.15g" if needs_double(mesh) else "%.9g"
    _, uv, corner = _seams(mesh, texture)
    faces, line = np.stack([mesh.faces, corner], axis=2) + 1, "f %d/%d %d/%d %d/%d"
    if mesh.normals is not None:
        faces, line = faces[..., [0, 1, 0]], "f %d/%d/%d %d/%d/%d %d/%d/%d"
    with open(path, "w", encoding="utf-8") as file:
        file.write(f"mtllib {material}\n")
        write_rows(file, "v" + f" {digits}" * 3, mesh.vertices)
        write_rows(file, "vt %.8f %.8f", uv)
        if mesh.normals is not None:
            write_rows(file, "vn %.6g %.6g %.6g", mesh.normals)
        file.write("usemtl surface\n")
        write_rows(file, line, faces.reshape(len(faces), -1))


def _glb(mesh: Mesh, texture: Texture, picture) -> bytes:
    import trimesh

    vertex, uv, faces = _seams(mesh, texture)
    center = mesh.bounds.mean(0) if needs_double(mesh) else np.zeros(3)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, baseColorFactor=[255, 255, 255, 255], metallicFactor=0.0, roughnessFactor=1.0
    )
    body = trimesh.Trimesh(
        vertices=mesh.vertices[vertex] - center,
        faces=faces,
        vertex_normals=None if mesh.normals is None else mesh.normals[vertex],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(body, node_name="mesh", transform=trimesh.transformations.translation_matrix(center))
    return scene.export(file_type="glb", include_normals=mesh.normals is not None)
