"""Finds what cameras see of a mesh: visible faces, vertex colours from photographs, and a rendered preview
of the mesh."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.capture.types import Photo
from linprim_geo.geometry.camera import Camera
from linprim_geo.geometry.mesh import Mesh
from linprim_geo.kernels import surface_ops
from linprim_geo.surface.mesh_views import MeshViews
from linprim_geo.surface.normals import vertex_normals

SAMPLES = np.array([[1 / 3, 1 / 3, 1 / 3], [0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
"""Barycentric coordinates of the points of a face that are tested: the centroid, and one near each corner."""

SURFACE_GAP = 1e-5
"""Rays towards a point of the mesh end this share of the diagonal in front of it: ten times Embree's rounding."""

KEPT_SAMPLES = 8
"""Most views from which a vertex takes its colour: the best ones, enough for a median that three bad ones
cannot move."""

COLOR_SPREAD = 24.0
"""Samples farther than this from the median in any channel (of 255) are left out of the average: highlights, occluders,
misaligned views."""

LEAST_FACING = 0.1
"""Views that see a vertex at a flatter angle than this (cosine, 84 degrees) are used only if there is no other."""

AROUND = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], bool)
"""The four neighbours of a pixel."""

BEHIND_SHARE = 1e-3
"""Points that are this share of their depth, and of the diagonal, behind the farthest surface in the pixels around them
may still be visible."""

FAR = 1e3
"""Depth of a ray that hits nothing, in diagonals: finite, so that differences stay numbers."""

POOR_SHARE = 1e-3
"""Factor on the weight of poor samples: in a pixel on an outline, whose colour is a mixture, or seen at too flat an
angle."""

OPAQUE = 0.98
"""Pixels with less alpha than this show some of the background."""

POINTS_PER_TASK = 32_768
"""Points whose samples are reduced to one colour at a time, so that temporaries stay in cache. Results do not depend on
it."""

POOR_RINGS = 3
"""Edges over which vertices with only poor samples take the colour of well seen ones: a pixel or two. Wires, which
consist of nothing but outline, keep their own colour."""


def visible_faces(mesh: Mesh, cameras: Sequence[Camera], caster: MeshViews | None = None) -> np.ndarray:
    """Return which faces any of the cameras sees, from either side.

    A face is visible if the ray through the centre of a pixel hits it first, or if one of four points on it lies in the
    image of a camera with nothing in between. A point farther away than what the four pixel centres around it see
    counts as hidden, so a gap narrower than a pixel shows nothing. `caster`: of the mesh, if there is one already.

    Returns:
        (F,) bool.
    Raises:
        LinprimError: the mesh is empty or not finite.
    """
    caster = caster or MeshViews(mesh.vertices, mesh.faces)
    seen = faces_of_pixels(caster, cameras)
    gap, before = SURFACE_GAP * caster.diagonal, np.zeros(len(seen), np.uint8)
    for camera in cameras:
        depth = caster.first_hits(camera)[0]
        behind = (BEHIND_SHARE, BEHIND_SHARE * caster.diagonal)
        surface_ops.face_samples(
            *camera.pinhole(), depth, caster.vertices, caster.faces, SAMPLES, *behind, seen.view(np.uint8), before
        )
        face = np.flatnonzero(before)
        row, sample = np.nonzero(before[face, None] >> np.arange(len(SAMPLES), dtype=np.uint8) & 1)
        face = face[row]
        ray = np.einsum("rk,rkd->rd", SAMPLES[sample], caster.vertices[caster.faces[face]]) - camera.center
        reach = 1.0 - gap / np.maximum(np.linalg.norm(ray, axis=1), 2.0 * gap)
        # Single precision rejects most occluded points; those that pass are tested again by `occluded`.
        for occluded in (caster.occluded_single, caster.occluded):
            left = ~occluded(camera.center, ray, reach)
            face, ray, reach = face[left], ray[left], reach[left]
        seen[face] = True
    return seen


def faces_of_pixels(caster: MeshViews, cameras: Sequence[Camera]) -> np.ndarray:
    """Return (F,) bool: faces that the ray through the centre of a pixel hits first.

    A ray that ends farther away than those of all four pixels around it has slipped through an edge, or looks through a
    gap narrower than a pixel, and is ignored.
    """
    from scipy.ndimage import maximum_filter

    seen = np.zeros(len(caster.faces), dtype=bool)
    for camera in cameras:
        depth, face = caster.first_hits(camera)
        believed = (face >= 0) & (depth <= maximum_filter(depth, footprint=AROUND, mode="nearest") * (1 + BEHIND_SHARE))
        seen[face[believed]] = True
    return seen


def pixels_of(photo: Photo) -> np.ndarray:
    """Return (H, W, 3) uint8 of a photograph, or with alpha (H, W, 4), as `sample_photographs` takes images."""
    return photo.rgb if photo.alpha is None else np.dstack([photo.rgb, photo.alpha])


def with_gain(pixels: np.ndarray, gain: float) -> np.ndarray:
    """Return (H, W, 3 or 4) float32 in units of white: `pixels_of` a photograph with the `gain` divided out of its
    colours."""
    image = pixels.astype(np.float32) / 255
    image[..., :3] /= gain
    return image


def color_vertices(
    mesh: Mesh, cameras: Sequence[Camera], images: Iterable[np.ndarray], caster: MeshViews | None = None
) -> np.ndarray:
    """Colour vertices from the photographs that see them.

    Each view that sees a vertex unoccluded gives its bilinear colour there, weighted by the cosine of the angle and by
    the resolution. The eight best samples per vertex are reduced to the average of those near their weighted median, so
    that a highlight or a misaligned view does not show. Vertices that no view sees take the colour of their neighbours;
    if no vertex is seen, all are mid-grey.

    Args:
        images: one (H, W, 3), or with alpha (H, W, 4), uint8, or float in [0, 1], per camera; iterated once, one in
            memory at a time.
        caster: of the mesh, if there is one already.
    Returns:
        (V, 3) uint8.
    Raises:
        LinprimError: an image does not have the size of its camera.
    """
    caster = caster or MeshViews(mesh.vertices, mesh.faces)
    normals = vertex_normals(mesh) if mesh.normals is None else mesh.normals
    edge = mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]]
    slack = float(np.median(np.linalg.norm(edge, axis=1)))
    colors, good, seen = sample_photographs(caster, mesh.vertices, normals, cameras, images, slack)
    return _fill_unseen(mesh, colors, good, seen)


def sample_photographs(
    caster: MeshViews,
    points: np.ndarray,
    normals: np.ndarray,
    cameras: Sequence[Camera],
    images: Iterable[np.ndarray],
    slack: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours of surface points (P, 3) with normals (P, 3), as `color_vertices` takes them from photographs.

    Memory: some 400 bytes per point.

    Args:
        caster: of the mesh that occludes points.
        images: one (H, W, 3 or 4) uint8, or float in [0, 1], per camera; iterated once. With a fourth channel, alpha,
            pixels of less than one half show the background, and those in between count as an outline.
        slack: a point this far behind the surface of a pixel is not occluded, in addition to what the slope explains;
            at least a pixel's footprint.
    Returns:
        colors (P, 3) float32 from 0 to 255, good (P,) bool: some view sees it well, seen (P,) bool: some view sees it
        at all.
    Raises:
        LinprimError: an image does not have the size of its camera.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    points, normals = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(normals, np.float64)
    count = len(points)
    best = np.zeros((count, KEPT_SAMPLES), dtype=np.float32)
    shade = np.zeros((count, KEPT_SAMPLES, 3), dtype=np.float32)
    good = np.zeros(count, dtype=np.uint8)
    rules = (slack, LEAST_FACING, POOR_SHARE, OPAQUE)
    for camera, image in zip(cameras, images, strict=True):
        if image.shape[:2] != (camera.height, camera.width):
            raise LinprimError(
                f"image is {image.shape[1]}x{image.shape[0]} pixels, its camera {camera.width}x{camera.height}"
            )
        image = image.astype(np.float32) * np.float32(1 if image.dtype == np.uint8 else 255)
        if image.shape[2] == 4:
            # Premultiplied, so that transparent pixels do not bleed into a sample beside them.
            image[..., :3] *= image[..., 3:] / 255
        # Single precision suffices here, as occlusion is tested with a slack.
        depth = np.minimum(caster.first_hits(camera)[0], np.float32(FAR * caster.diagonal))
        near, far = (extreme(depth, size=3, mode="nearest") for extreme in (minimum_filter, maximum_filter))
        surface_ops.add_colors(*camera.pinhole(), image, depth, near, far, rules, points, normals, best, shade, good)
    parts = range(0, count, POINTS_PER_TASK)
    with ThreadPoolExecutor(caster.threads) as pool:
        means = pool.map(lambda k: _robust_mean(best[k : k + POINTS_PER_TASK], shade[k : k + POINTS_PER_TASK]), parts)
        colors = np.concatenate([np.zeros((0, 3), np.float32), *means])
    return colors, good.astype(bool), best[:, 0] > 0


def _robust_mean(best: np.ndarray, shade: np.ndarray) -> np.ndarray:
    """Return (V, 3) float32: the weighted mean of the samples near the weighted median of each channel."""
    total = best.sum(1)
    median = np.empty((len(best), 3), dtype=np.float32)
    for channel in range(3):
        order = np.argsort(shade[:, :, channel], axis=1, kind="stable")
        weights = np.cumsum(np.take_along_axis(best, order, axis=1), axis=1)
        middle = np.argmax(weights >= 0.5 * total[:, None], axis=1)
        picked = np.take_along_axis(order, middle[:, None], axis=1)
        median[:, channel] = np.take_along_axis(shade[:, :, channel], picked, axis=1)[:, 0]
    near = (np.abs(shade - median[:, None]) <= COLOR_SPREAD).all(2)
    weights = best * near
    total = weights.sum(1, keepdims=True)
    mean = np.einsum("vk,vkc->vc", weights, shade)
    return np.where(total > 0, mean / np.maximum(total, np.finfo(np.float32).tiny), median)


def _fill_unseen(mesh: Mesh, colors: np.ndarray, good: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Spread colours along edges: from well seen vertices a few edges far, then into those that no view sees.

    Components without a seen vertex get the mean colour of all seen ones.
    """
    from scipy.sparse import coo_matrix

    colors = colors.astype(np.float64)
    colors[~seen] = colors[seen].mean(0) if seen.any() else 128.0
    if seen.any() and not good.all():
        ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        ends = np.concatenate([ends, ends[:, ::-1]])
        graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(seen), len(seen))).tocsr()

        def grow(known, among):
            around = graph @ known.astype(np.float64)
            new = (around > 0) & ~known & among
            colors[new] = (graph @ (colors * known[:, None]))[new] / around[new, None]
            return known | new, new.any()

        for _ in range(POOR_RINGS):
            good, _ = grow(good, seen)
        known, more = seen, True
        while more:
            known, more = grow(known, ~seen)
    return np.clip(np.round(colors), 0, 255).astype(np.uint8)


def render_preview(
    mesh: Mesh,
    camera: Camera,
    *,
    colors: np.ndarray | None = None,
    smooth: bool = False,
    supersample: int = 2,
    background: tuple[int, int, int] = (255, 255, 255),
    caster: MeshViews | None = None,
) -> np.ndarray:
    """Render a mesh by ray casting, without a graphics library: Lambert shading with the light at the camera.

    Args:
        colors: (V, 3) uint8 vertex colours; the mesh's own by default, light grey if it has none.
        smooth: interpolate vertex normals; else each face is flat, which shows the triangulation. Faces seen from
            behind are bluish, which reveals holes and inverted parts.
        supersample: rays per pixel along each axis.
        caster: of the mesh, if there is one.

    Returns:
        (H, W, 3) uint8.
    """
    k = supersample
    rays = camera.magnified(k).world_rays().reshape(-1, 3)
    caster = caster or MeshViews(mesh.vertices, mesh.faces)
    _, face, bary = caster.cast(camera.center, rays)
    hit = face >= 0
    corners = mesh.faces[face[hit]]
    weights = np.concatenate([1.0 - bary[hit].sum(1, keepdims=True), bary[hit]], axis=1)
    colors = mesh.colors if colors is None else colors
    base = np.full((len(corners), 3), 210.0)
    if colors is not None:
        base = np.einsum("rk,rkc->rc", weights, np.asarray(colors)[corners].astype(np.float64))
    flat = caster.face_normals()[face[hit]]
    direction = rays[hit] / np.linalg.norm(rays[hit], axis=1, keepdims=True)
    behind = np.einsum("ij,ij->i", flat, direction) > 0
    normal = flat
    if smooth:
        normals = vertex_normals(mesh) if mesh.normals is None else mesh.normals.astype(np.float64)
        normal = np.einsum("rk,rkc->rc", weights, normals[corners])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = 0.25 + 0.75 * np.abs(np.einsum("ij,ij->i", normal, direction))
    base = np.where(behind[:, None], 0.4 * base + 0.6 * np.array([90.0, 110.0, 200.0]), base)
    picture = np.empty((len(rays), 3))
    picture[:] = background
    picture[hit] = base * light[:, None]
    picture = picture.reshape(camera.height, k, camera.width, k, 3).mean((1, 3))
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)
