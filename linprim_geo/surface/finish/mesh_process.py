"""Finishes extracted meshes: closes holes, smooths, remeshes and simplifies, and records what each step does to the
topology.

PyMeshLab does the work, except for simplification within a tolerance, whose error no library bounds. PyMeshLab is
under the GPL, so it is imported only where a mesh is finished.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from linprim_geo.base.errors import LinprimError
from linprim_geo.geometry.mesh import Mesh, face_areas, face_components
from linprim_geo.geometry.topology import manifold_status, topology
from linprim_geo.kernels import surface_ops
from linprim_geo.surface.normals import vertex_normals

# Taubin's own two factors. A sphere of 2,000 vertices grows by 0.17 % of its volume in 10 iterations, one of 66
# vertices shrinks by 1.4 %.
TAUBIN = {"lambda_": 0.33, "mu": -0.34}
REMESH_ROUNDS = 5
# Dihedral angle in degrees from which remeshing keeps an edge as a feature, as in MeshLab.
FEATURE_DEGREES = 30.0
# A remeshing that would give more faces than this is refused.
MOST_FACES = 20_000_000
FEWEST_FACES = 4
# Tolerance `auto`, as a share of the predicted errors. Added as independent errors, the total is 1.12 times the
# predicted error.
SHARE_OF_ERROR = 0.5


def process_mesh(mesh: Mesh, options, note: Callable[[str], None] | None = None) -> tuple[Mesh, list[dict]]:
    """Apply the steps that the options ask for, in this order: `close_holes`, `smooth`, `remesh`, `tolerance`,
    `target_faces`. 0 turns a step off; `close_holes` auto has been done before.

    Args:
        options: has these five attributes, as `ExtractOptions`.
        note: called with one line per step.
    Returns:
        The mesh and one entry per step, as `stats.json` holds them: `step`, its parameter, `faces_before`,
        `faces_after`, `boundary_edges`, `non_manifold_edges`, `watertight` (of the result), `topology_kept` (same
        number of components, of edges with too many faces, and same Euler characteristic as before; closing holes
        changes the latter on purpose) and, where a step was not done or done differently, `note`.
    Raises:
        LinprimError: an empty mesh, coordinates that are not finite, or a parameter that no mesh can be made with.
    """
    steps: list[tuple[str, str, float | str, Callable[[Mesh], tuple[Mesh, str | None]]]] = []
    entries = []
    if options.close_holes != "auto" and options.close_holes:
        steps.append(
            ("close_holes", "max_edges", options.close_holes, partial(_close_holes, max_edges=options.close_holes))
        )
    if options.smooth:
        steps.append(("smooth", "iterations", options.smooth, partial(_smooth, iterations=options.smooth)))
    if options.remesh:
        steps.append(("remesh", "edge_length", options.remesh, partial(_remesh, length=options.remesh)))
    if options.tolerance:
        steps.append(
            ("simplify", "tolerance", options.tolerance, partial(_within_tolerance, tolerance=options.tolerance))
        )
    if options.target_faces:
        steps.append(
            ("simplify", "target_faces", options.target_faces, partial(_simplify, target=options.target_faces))
        )
    for name, parameter, value, function in steps:
        before = _shape(mesh)
        mesh, remark = function(mesh)
        after = _shape(mesh)
        entry = {
            "step": name,
            parameter: value,
            "faces_before": before["faces"],
            "faces_after": after["faces"],
            "boundary_edges": after["boundary_edges"],
            "non_manifold_edges": after["non_manifold_edges"],
            "watertight": after["watertight"],
            "topology_kept": all(before[key] == after[key] for key in ("components", "non_manifold_edges", "euler")),
        }
        text = f"{name}: {before['faces']} -> {after['faces']} faces, "
        text += f"{before['boundary_edges']} -> {after['boundary_edges']} boundary edges"
        if remark:
            entry["note"] = remark
            text += f"; {remark}"
        entries.append(entry)
        if note:
            note(text)
    return mesh, entries


def simplify(mesh: Mesh, target_faces: int) -> Mesh:
    """Collapse edges by quadric error until `target_faces` are left; flat parts lose their faces first.

    The topology and every boundary edge stay, so more faces can be left than asked for (close holes before); a closed
    mesh stays closed. Colours and quality are taken from the nearest points of the old surface. If the mesh has no more
    than that many faces, it is returned unchanged.

    Raises:
        LinprimError: an empty mesh, coordinates that are not finite, or fewer than 4 faces wanted.
    Source: Garland and Heckbert, Surface simplification using quadric error metrics, 1997.
    """
    return _simplify(mesh, target_faces)[0]


def within_tolerance(mesh: Mesh, tolerance: float | str) -> Mesh:
    """Simplify the mesh so that each old vertex is at most `tolerance` from the new surface, in its unit, or with
    `auto` at most SHARE_OF_ERROR of its predicted error (`quality`; the median where it is unknown).

    Flat parts lose most of their faces, curved ones as many as the tolerance allows. The topology stays, and boundaries
    keep within the tolerance, too. Colours and quality are taken from the nearest points of the old surface. Memory:
    some 600 bytes per vertex. The result is identical to the last bit every time.

    Raises:
        LinprimError: an empty mesh, coordinates that are not finite, a tolerance that is not positive, or `auto` of a
            mesh without predicted errors.
    Source: Garland and Heckbert 1997; Hoppe, Progressive meshes, 1996 (csrc/surface/simplify.h).
    """
    return _within_tolerance(mesh, tolerance)[0]


def smooth(mesh: Mesh, iterations: int) -> Mesh:
    """Smooth the mesh by Taubin's method: move vertices towards the mean of their neighbours, and back by slightly
    more, which removes noise and keeps the volume.

    Faces, colours and quality stay.

    Raises:
        LinprimError: an empty mesh, coordinates that are not finite, or a negative number.
    Source: Taubin, A signal processing approach to fair surface design, 1995.
    """
    return _smooth(mesh, iterations)[0]


def close_holes(mesh: Mesh, max_edges: int) -> Mesh:
    """Fill every hole whose boundary has at most `max_edges` edges with triangles between its vertices.

    Raises:
        LinprimError: an empty mesh, coordinates that are not finite, or a negative number.
    """
    return _close_holes(mesh, max_edges)[0]


def remesh(mesh: Mesh, edge_length: float) -> Mesh:
    """Remesh the same surface with even triangles whose edges are about `edge_length` long; creases of more than 30
    degrees stay.

    Colours and quality are taken from the nearest points of the old surface. A closed mesh stays closed: where
    remeshing would open it, the mesh is returned unchanged.

    Raises:
        LinprimError: an empty mesh, coordinates that are not finite, or a length that gives no faces or millions of
            them.
    Source: Botsch and Kobbelt, A remeshing approach to multiresolution modeling, 2004.
    """
    return _remesh(mesh, edge_length)[0]


def _simplify(mesh: Mesh, target: int) -> tuple[Mesh, str | None]:
    _check(mesh)
    if target < FEWEST_FACES:
        raise LinprimError(f"--target-faces is {target}, wanted at least {FEWEST_FACES}, or 0 for all faces")
    if len(mesh.faces) <= target:
        return mesh, f"the mesh has no more than {target} faces: left as it is"
    closed = _is_closed(mesh)
    result = _filtered(
        mesh,
        "meshing_decimation_quadric_edge_collapse",
        targetfacenum=int(target),
        # Without this, edges of three faces appear along boundaries, whatever `preservetopology` says.
        preserveboundary=True,
        preservenormal=True,
        preservetopology=True,
        planarquadric=True,
    )
    remark = None
    if closed and not _is_closed(result):
        result, remark = _decimated(mesh, target), "by libigl, which keeps it closed"
        if not _is_closed(result):
            return mesh, "it would not stay closed: left as it is"
    if len(result.faces) > target:
        fewer = f"no fewer than {len(result.faces)} faces without changing the topology"
        remark = f"{remark}, {fewer}" if remark else fewer
    return _with_attributes(result, mesh), remark


def _within_tolerance(mesh: Mesh, tolerance: float | str) -> tuple[Mesh, str | None]:
    _check(mesh)
    remark = None
    if tolerance == "auto":
        error = np.zeros(0) if mesh.quality is None else mesh.quality.astype(np.float64)
        known = np.isfinite(error) & (error > 0)
        if not known.any():
            raise LinprimError("--tolerance is auto, but the mesh has no predicted errors: wanted a length")
        most = SHARE_OF_ERROR * np.where(known, error, np.median(error[known]))
        remark = f"within {SHARE_OF_ERROR:g} of the predicted errors, {np.median(most):.3g} in the median"
    elif isinstance(tolerance, str) or not tolerance > 0:
        raise LinprimError(f"--tolerance is {tolerance}, wanted auto or a length above 0")
    else:
        most = np.full(len(mesh.vertices), float(tolerance))
    center = mesh.bounds.mean(0)
    vertices = np.ascontiguousarray(mesh.vertices - center, np.float64)
    vertices, faces = surface_ops.simplify(np.ascontiguousarray(mesh.faces, np.int64), vertices, most)
    return _with_attributes(Mesh(vertices + center, faces), mesh), remark


def _smooth(mesh: Mesh, iterations: int) -> tuple[Mesh, str | None]:
    _check(mesh)
    if iterations < 0:
        raise LinprimError(f"--smooth is {iterations}, wanted a number of iterations from 0 on")
    if iterations == 0:
        return mesh, None
    moved = _filtered(mesh, "apply_coord_taubin_smoothing", stepsmoothnum=int(iterations), **TAUBIN)
    result = replace(mesh, vertices=moved.vertices)
    return replace(result, normals=None if mesh.normals is None else vertex_normals(result)), None


def _close_holes(mesh: Mesh, max_edges: int) -> tuple[Mesh, str | None]:
    _check(mesh)
    if max_edges < 0:
        raise LinprimError(f"--close-holes is {max_edges}, wanted a number of edges from 0 on")
    shape = topology(mesh)
    if max_edges == 0 or shape["boundary_edges"] == 0:
        return mesh, "there are no holes" if max_edges else None
    faces, left = mesh.faces, 0
    # The first round refuses self-intersecting patches, which leaves some holes open; the second accepts them.
    for refuse in (True, False):
        # PyMeshLab refuses edges of three faces, so the mesh is cut apart there; patches that would close those cuts
        # are dropped as not sound. It fills holes with fewer edges than `maxholesize`.
        vertex, fans = _cut_apart(faces)
        cut = Mesh(mesh.vertices[vertex], fans)
        if topology(cut)["non_manifold_edges"]:
            left = len(faces)
            break
        filled = _filtered(cut, "meshing_close_holes", maxholesize=int(max_edges) + 1, selfintersection=refuse)
        if len(filled.vertices) != len(vertex) or not np.array_equal(filled.faces[: len(faces)], fans):
            raise LinprimError(f"PyMeshLab's meshing_close_holes did not keep the {len(faces)} faces that there were")
        added = vertex[filled.faces[len(faces) :]]
        sound = _sound_patches(faces, added)
        left = int((~sound).sum())
        faces = np.concatenate([faces, added[sound]])
    result = replace(mesh, faces=faces, primitive=None)
    remark = "some holes could be closed only with edges of three faces, and stay" if left else None
    return replace(result, normals=None if mesh.normals is None else vertex_normals(result)), remark


def _cut_apart(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give every fan (faces around a vertex, joined by edges of two faces) a vertex of its own.

    Returns the old vertex of each new one, and the faces (F, 3) with new vertices.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    one, other = paired_edges(faces)
    # Edge 3f+k runs from corner 3f+k to the next one of face f, and its partner the other way.
    after_one, after_other = (3 * (edge // 3) + (edge + 1) % 3 for edge in (one, other))
    rows, columns = np.concatenate([one, after_one]), np.concatenate([after_other, other])
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(faces.size, faces.size))
    count, fan = connected_components(graph, directed=False)
    vertex = np.empty(count, dtype=np.int64)
    vertex[fan] = faces.ravel()
    return vertex, fan.reshape(-1, 3).astype(np.int64)


def paired_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the edges of faces (F, 3) that exactly two faces share, in opposite directions: (E,) and (E,) numbers 3f+k
    of the edge of face f from its corner k to the next."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])
    first = np.flatnonzero(new)
    first = first[np.diff(np.append(first, len(order))) == 2]
    one, other = order[first], order[first + 1]
    proper = (start[one] < end[one]) != (start[other] < end[other])
    return one[proper], other[proper]


def _sound_patches(faces: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which of the `added` faces (N, 3) are in a patch without an edge of more than two faces."""
    bad = has_crowded_edge(faces, added)
    _, patch = face_components(Mesh(np.zeros((int(added.max(initial=-1)) + 1, 3)), added))
    return ~np.isin(patch, patch[bad])


def has_crowded_edge(faces: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Return (N,) bool: which of the `added` faces (N, 3) have an edge that more than two faces share, of (F, 3)
    `faces` and the added ones together."""
    count = int(max(faces.max(), added.max(initial=0))) + 1
    ends = np.sort(np.concatenate([faces, added])[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, edge, uses = np.unique(ends[:, 0] * np.int64(count) + ends[:, 1], return_inverse=True, return_counts=True)
    return np.any((uses[edge] > 2).reshape(-1, 3), axis=1)[len(faces) :]


def _remesh(mesh: Mesh, length: float) -> tuple[Mesh, str | None]:
    import pymeshlab

    _check(mesh)
    if length == 0:
        return mesh, None
    if not 0 < length < mesh.diagonal:
        raise LinprimError(
            f"--remesh is {length:g}, wanted a length below the mesh's diagonal of {mesh.diagonal:.4g}, or 0"
        )
    count = float(face_areas(mesh).sum()) / (np.sqrt(3.0) / 4.0 * length**2)
    if count > MOST_FACES:
        raise LinprimError(
            f"--remesh is {length:g}, which would give some {count:.3g} faces, wanted at most {MOST_FACES}: "
            f"{length * np.sqrt(count / MOST_FACES):.2g} or more"
        )
    if count < FEWEST_FACES:
        raise LinprimError(f"--remesh is {length:g}, too long for a surface of area {face_areas(mesh).sum():.4g}")
    result = _filtered(
        mesh,
        "meshing_isotropic_explicit_remeshing",
        iterations=REMESH_ROUNDS,
        targetlen=pymeshlab.PureValue(length / mesh.diagonal),
        featuredeg=FEATURE_DEGREES,
    )
    if len(result.faces) == 0 or (_is_closed(mesh) and not _is_closed(result)):
        return mesh, "it would not stay closed: left as it is"
    return _with_attributes(result, mesh), None


def _check(mesh: Mesh) -> None:
    """Raise LinprimError for meshes that pymeshlab or igl would crash on."""
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise LinprimError(
            f"the mesh is empty ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces), wanted a surface to finish"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise LinprimError(f"the mesh has {len(mesh.vertices)} vertices, but a face uses vertex {mesh.faces.max()}")
    bad = ~np.isfinite(mesh.vertices).all(1)
    if bad.any():
        raise LinprimError(f"vertex {int(np.argmax(bad))} of the mesh is not finite ({int(bad.sum())} are not)")
    if mesh.diagonal == 0:
        raise LinprimError(
            f"all {len(mesh.vertices)} vertices of the mesh lie in one point, wanted a surface to finish"
        )


def _filtered(mesh: Mesh, name: str, **parameters) -> Mesh:
    """Return vertices and faces of the mesh after one filter, to which the mesh is given centred at the origin with a
    diagonal of 1."""
    import pymeshlab

    center, scale = mesh.bounds.mean(0), mesh.diagonal
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh((mesh.vertices - center) / scale, mesh.faces.astype(np.int32)))
    try:
        meshes.apply_filter(name, **parameters)
    except pymeshlab.PyMeshLabException as error:
        raise LinprimError(f"PyMeshLab's {name} failed on {len(mesh.faces)} faces ({error})") from error
    made = meshes.current_mesh()
    return Mesh(made.vertex_matrix() * scale + center, made.face_matrix())


def _decimated(mesh: Mesh, target: int) -> Mesh:
    """Simplify with libigl, which takes only closed (or edge-manifold) meshes and collapses no edge that would open
    them."""
    import igl

    center, scale = mesh.bounds.mean(0), mesh.diagonal
    points = np.ascontiguousarray((mesh.vertices - center) / scale)
    vertices, faces = igl.qslim(points, mesh.faces, int(target))[:2]
    return Mesh(vertices * scale + center, faces)


def _with_attributes(made: Mesh, source: Mesh) -> Mesh:
    """Return `made` with the colours and quality of the nearest points of `source`, and with normals if
    that has them."""
    colors = quality = None
    if source.colors is not None or source.quality is not None:
        corners, weights = _nearest(source, made.vertices)
        if source.colors is not None:
            mixed = np.einsum("vk,vkc->vc", weights, source.colors[corners].astype(np.float64))
            colors = np.clip(np.round(mixed), 0, 255)
        if source.quality is not None:
            quality = np.einsum("vk,vk->v", weights, source.quality[corners].astype(np.float64))
    normals = None if source.normals is None else vertex_normals(made)
    return replace(made, normals=normals, colors=colors, quality=quality)


def _nearest(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (P, 3) of the faces nearest to points (P, 3), and the (P, 3) barycentric weights of the
    nearest points in them."""
    import igl

    from linprim_geo.geometry.mesh import barycentric

    center = mesh.bounds.mean(0)
    vertices = np.ascontiguousarray(mesh.vertices - center)
    tree = igl.AABB()
    tree.init(vertices, mesh.faces)
    _, face, closest = tree.squared_distance(vertices, mesh.faces, np.ascontiguousarray(points - center))
    corners = mesh.faces[face]
    inner = np.clip(barycentric(closest, vertices[corners]), 0.0, 1.0)
    inner /= np.maximum(inner.sum(1, keepdims=True), 1.0)
    return corners, np.concatenate([1.0 - inner.sum(1, keepdims=True), inner], axis=1)


def _is_closed(mesh: Mesh) -> bool:
    return len(mesh.faces) > 0 and topology(mesh)["watertight"] and manifold_status(mesh) == "NoError"


def _shape(mesh: Mesh) -> dict:
    """Return `topology` with the Euler characteristic as `euler`."""
    shape = topology(mesh)
    ends = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = len(np.unique(ends[:, 0] * np.int64(len(mesh.vertices)) + ends[:, 1]))
    return shape | {"euler": shape["vertices"] - edges + shape["faces"]}
