#!/usr/bin/env python3
"""Times the rasterizer on a procedural furnished room of N primitives, and the core's limits at the same time.

    python tools/bench.py --primitives 50000 --threads 1 --json

Times are ns per (pixel, primitive) hit, forward and backward. Primitives lie on the surfaces of a 6 x 3 x 5 m room with
boxes and spheres. Their size is chosen such that the number over a point of the surface does not depend on N. The
camera looks in from the open front. Forward, backward and the limits are measured alternately; results are medians. The
limits are those of one thread and instruction set: peak multiply-adds, the vector exponential, and the bare pair
kernels of octahedra with all data in the L1 cache and every pixel hit (csrc/raster/machine_limits.h).
"""

from __future__ import annotations

import argparse
import json
import os
import time

import numpy as np


def room(count: int, seed: int = 0, overlap: float = 0.60) -> dict[str, np.ndarray]:
    """Return `count` flat octahedra on the room's surfaces. With s = overlap sqrt(area / count), the half-axes are 2.6
    s in the surface and 0.15 times that across it."""
    rng = np.random.default_rng(seed)
    walls: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def box(center, half, faces="xXyYzZ"):
        center, half = np.array(center, float), np.array(half, float)
        for face in faces:
            axis, side = "xyz".index(face.lower()), -1 if face.islower() else 1
            origin, u, v = center - half, np.zeros(3), np.zeros(3)
            origin[axis] = center[axis] + side * half[axis]
            u[(axis + 1) % 3], v[(axis + 2) % 3] = 2 * half[(axis + 1) % 3], 2 * half[(axis + 2) % 3]
            walls.append((origin, u, v))

    box([0, 0, 4.5], [3, 1.5, 2.5], "xXyYZ")
    box([-1.5, 0.9, 5.0], [0.6, 0.6, 0.6])
    box([1.4, 0.7, 4.4], [0.5, 0.8, 0.4])
    box([0.1, 1.2, 3.6], [0.8, 0.3, 0.4])
    balls = [
        (np.array([0.2, 0.4, 5.2]), 0.7),
        (np.array([-1.3, -0.5, 4.2]), 0.45),
        (np.array([1.6, -0.7, 5.6]), 0.6),
    ]
    areas = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in walls] + [4 * np.pi * r * r for _, r in balls])
    which = rng.choice(len(areas), count, p=areas / areas.sum())
    center, normal = np.zeros((count, 3)), np.zeros((count, 3))
    for k, (origin, u, v) in enumerate(walls):
        mine = which == k
        a, b = rng.random((2, mine.sum(), 1))
        center[mine] = origin + a * u + b * v
        normal[mine] = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    for k, (middle, radius) in enumerate(balls):
        mine = which == len(walls) + k
        direction = rng.normal(size=(mine.sum(), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        center[mine], normal[mine] = middle + radius * direction, direction
    s = overlap * np.sqrt(areas.sum() / count)
    extent = 2.6 * np.stack(
        [
            s * np.exp(rng.uniform(-0.5, 0.5, count)),
            s * np.exp(rng.uniform(-0.5, 0.5, count)),
            np.full(count, 0.15 * s),
        ],
        1,
    )
    # Quaternion that rotates z to the normal, after a random rotation about z.
    spin = rng.uniform(0, 2 * np.pi, count) / 2
    turn = np.concatenate([(1 + normal[:, 2])[:, None], np.cross([0.0, 0.0, 1.0], normal)], 1)
    turn[normal[:, 2] < -0.999999] = [0, 1, 0, 0]
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    (w, x, y, z), (c, d) = turn.T, (np.cos(spin), np.sin(spin))
    rotation = np.stack([w * c - z * d, x * c + y * d, y * c - x * d, w * d + z * c], 1)
    opacity = rng.uniform(0.1, 0.95, count)
    rgb = 0.5 + 0.35 * np.sin(2.3 * center + np.array([0, 2, 4])) + rng.normal(0, 0.05, (count, 3))
    sh = rng.normal(0, 0.05, (count, 16, 3))
    sh[:, 0] = (rgb - 0.5) / 0.28209479177387814
    density = -np.log1p(-opacity) / (2 * extent.min(1))
    return {
        k: np.ascontiguousarray(v, np.float32)
        for k, v in dict(center=center, rotation=rotation, extent=extent, density=density, sh=sh).items()
    }


def as_kind(arrays: dict[str, np.ndarray], kind: str) -> dict[str, np.ndarray]:
    """Return the same room made of Gaussians (half-axes are 2.6 standard deviations, opacity along the shortest) or of
    tetrahedra of equal volume."""
    if kind == "gaussian":
        opacity = -np.expm1(-2 * arrays["density"] * arrays["extent"].min(1))
        return arrays | {"extent": arrays["extent"] / np.float32(2.6), "density": opacity}
    if kind == "tetrahedron":
        # The volume 8 sqrt(3) / 27 r^3 of a regular tetrahedron of circumradius r equals 4/3 a b c.
        radius = np.cbrt(arrays["extent"].prod(1) * (4 / 3) * 27 / (8 * np.sqrt(3)))
        return arrays | {"extent": np.repeat(radius[:, None], 4, 1).astype(np.float32)}
    return arrays


def median_spread(values: list[float]) -> dict[str, float]:
    """Return the median and the quartiles."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return {"median": float(middle), "low": float(low), "high": float(high)}


def measure(
    count: int, threads: int, runs: int, geometry: bool, variant: dict[str, str], width: int = 800, height: int = 600
) -> dict:
    """Time forward, backward, loss, optimiser and the machine's limits alternately, `runs` times after two warm-up
    runs.

    `variant` holds the keywords primitive, ray_model and order of `ops.rasterize`.
    """
    import torch

    from linprim_geo.geometry.camera import Camera
    from linprim_geo.kernels import ops
    from linprim_geo.kernels.adam import adam_step

    torch.set_num_threads(threads)
    ops.set_threads(threads)
    parameters = [torch.from_numpy(v).requires_grad_() for v in as_kind(room(count), variant["primitive"]).values()]
    background = torch.zeros(3, requires_grad=True)
    moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in parameters]
    camera = Camera(width, height, 0.75 * width, 0.75 * width, width / 2, height / 2, np.eye(4))
    target = torch.rand(3, height, width, generator=torch.Generator().manual_seed(0))
    times: dict[str, list[float]] = {}
    limits: dict[str, list[float]] = {}

    def note(name: str, ms: float) -> None:
        times.setdefault(name, []).append(ms)

    stats = {}
    for run in range(runs + 2):
        marks = [time.perf_counter()]
        out = ops.rasterize(*parameters, background, camera, geometry=geometry, **variant)
        marks.append(time.perf_counter())
        loss = ops.photometric_loss(out.rgb, target)[0]
        marks.append(time.perf_counter())
        grads = torch.autograd.grad(loss, parameters)
        marks.append(time.perf_counter())
        for p, g, (first, second) in zip(parameters, grads, moments, strict=True):
            adam_step(p, g, first, second, 0.0, run + 1)
        marks.append(time.perf_counter())
        if run < 2:
            continue
        for name, value in ops.machine_limits().items():
            limits.setdefault(name, []).append(value)
        stats = ops.statistics()
        for stage in ("project", "sort", "bin", "forward", "backward", "project_backward"):
            note(stage, stats[f"{stage}_ms"])
        for name, a, b in (
            ("call_forward", 0, 1),
            ("loss", 1, 2),
            ("call_backward", 2, 3),
            ("optimiser", 3, 4),
            ("iteration", 0, 4),
        ):
            note(name, 1e3 * (marks[b] - marks[a]))
    stages = {name: median_spread(values) for name, values in times.items()}
    hits = stats["hit_lanes"]
    limit = {name: median_spread(values) for name, values in limits.items()}
    return {
        **variant,
        "primitives": count,
        "threads": threads,
        "instruction_set": ops.instruction_set(),
        "geometry": geometry,
        "image": [width, height],
        "visible": stats["visible"],
        "hits": hits,
        "pairs": stats["pairs"],
        "visited_per_hit": stats["visited_lanes"] / hits,
        "pairs_per_tile": stats["pairs"] / (-(-width // 16) * -(-height // 16)),
        "forward_ns_per_hit": 1e6 * sum(stages[s]["median"] for s in ("project", "sort", "bin", "forward")) / hits,
        "backward_ns_per_hit": 1e6 * sum(stages[s]["median"] for s in ("backward", "project_backward")) / hits,
        "raster_forward_ns_per_hit": 1e6 * stages["forward"]["median"] / hits,
        "raster_backward_ns_per_hit": 1e6 * stages["backward"]["median"] / hits,
        "limit_forward_ns": limit["pair_forward_ns"]["median"],
        "limit_backward_ns": limit["pair_backward_ns"]["median"],
        "limit_exp_ns": limit["exp_ns"]["median"],
        "limit_fma_gflops": limit["fma_gflops"]["median"],
        "limits": limit,
        "iteration_ms": stages["iteration"]["median"],
        "stages_ms": stages,
        "working_set_mib": stats["working_set_bytes"] / 2**20,
        "load": os.getloadavg()[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--primitives", type=int, nargs="+", default=[10_000, 50_000, 200_000], metavar="N")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=15, help="measured repetitions")
    parser.add_argument("--primitive", choices=("octahedron", "tetrahedron", "gaussian"), default="octahedron")
    parser.add_argument("--ray-model", choices=("exact", "affine"), default="exact")
    parser.add_argument("--order", choices=("center", "entry", "overlap"), default="center")
    parser.add_argument("--instruction-set", default="auto", help="scalar, v2, v3, v4 or neon; auto: the best one")
    parser.add_argument("--geometry", action="store_true", help="also compute depths, normals and distortion")
    parser.add_argument("--json", action="store_true", help="print one JSON object (a list for several N)")
    args = parser.parse_args()
    from linprim_geo.kernels import ops

    ops.set_instruction_set(args.instruction_set)
    variant = {"primitive": args.primitive, "ray_model": args.ray_model, "order": args.order}
    results = [measure(n, args.threads, args.runs, args.geometry, variant) for n in args.primitives]
    if args.json:
        print(json.dumps(results[0] if len(results) == 1 else results, indent=2))
        return
    for r in results:
        s = {k: v["median"] for k, v in r["stages_ms"].items()}
        print(
            f"{r['primitives']:>7} primitives, {r['threads']} thread(s), {r['instruction_set']}: "
            f"{r['hits'] / 1e6:.2f} M hits, "
            f"{r['visited_per_hit']:.2f} visited per hit, {r['pairs']} pairs"
        )
        print(
            f"        forward {r['forward_ns_per_hit']:.2f} ns/hit (tiles alone {r['raster_forward_ns_per_hit']:.2f}), "
            f"backward {r['backward_ns_per_hit']:.2f} ({r['raster_backward_ns_per_hit']:.2f}), iteration "
            f"{r['iteration_ms']:.1f} ms"
        )
        forward = r["raster_forward_ns_per_hit"] / r["visited_per_hit"] / r["limit_forward_ns"]
        backward = r["raster_backward_ns_per_hit"] / r["limit_backward_ns"]
        print(
            f"        limits: pair {r['limit_forward_ns']:.2f} forward, {r['limit_backward_ns']:.2f} backward, "
            f"exp {r['limit_exp_ns']:.2f} ns, {r['limit_fma_gflops']:.0f} GFLOP/s; "
            f"tiles forward {forward:.2f} times that per visited lane, backward {backward:.2f} times per hit"
        )
        print(
            "        ms: "
            + ", ".join(f"{k} {v:.2f}" for k, v in s.items())
            + f"; working set {r['working_set_mib']:.0f} MiB"
        )


if __name__ == "__main__":
    main()
