"""Checks that the tests detect wrong code in the C++ core: `python tools/mutate_core.py`.

Builds a copy of the core with one wrong line at a time (a mutation), uses it in place of the installed one, and runs
the test files that cover the line until the first failure. A mutation that no test detects is reported as `SURVIVED`.
The real sources are never changed. Exit status: 1 if a mutation survives, 2 if the tests fail without a mutation.

To compile in a third of the time, the copy has only the kernels for AVX2 and, in double precision, the scalar ones, and
is built without the compiler's slower optimisations. Every mutation in the list changes some result. Needs an x86-64
processor with AVX2, the environment of `make env`, and half an hour.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sanitize import ROOT, build, run_pytest

from linprim_geo.base.cores import usable_cores

# Seconds after which tests on a mutated core are stopped, which counts as detecting the mutation.
PATIENCE = 900


class Edit(NamedTuple):
    file: str  # under the root
    snippet: str  # occurs there exactly once
    replacement: str


class Mutation(NamedTuple):
    edit: Edit
    tests: tuple[str, ...]  # under tests/


# Parts that are left out of the build of the copy.
REDUCTIONS = (
    Edit("CMakeLists.txt", "  linprim_kernels(v2 -msse4.2 -mpopcnt)\n", ""),
    Edit(
        "CMakeLists.txt",
        "  linprim_kernels(v4 -mavx512f -mavx512bw -mavx512cd -mavx512dq -mavx512vl -mfma -mbmi -mbmi2 -mpopcnt\n"
        "                  -mprefer-vector-width=512)\n",
        "",
    ),
    Edit("CMakeLists.txt", "INTERFACE -O3)", "INTERFACE -O1)"),
    # "scalar" in single precision is the AVX2 kernels under that name.
    Edit(
        "csrc/raster/kernels.cpp",
        "template <>\nconst Kernels<float>& kernels_scalar<float>() {\n  return LINPRIM_ISA::table<float>;\n}\n",
        "",
    ),
    Edit(
        "csrc/raster/instruction_set.cpp",
        "namespace linprim {\nnamespace {\n\nstruct Choice {",
        "namespace linprim {\ntemplate <>\nconst Kernels<float>& kernels_scalar<float>() {\n"
        '  static Kernels<float> named = kernels_v3();\n  named.name = "scalar";\n  return named;\n}\n'
        "namespace {\n\nstruct Choice {",
    ),
)

CENTER = tuple(
    f"kernels/test_{name}.py"
    for name in ("rasterize_gradients", "rasterize", "rasterize_invariants", "rasterize_interface", "ladder")
)
LADDER = (CENTER[-1], *CENTER[:-1])
SEGMENTS = ("kernels/test_solid_tree.py", "surface/methods/test_method_polyhedra.py")
FUSING = ("surface/fusion/test_surfels.py", "surface/fusion/test_tsdf.py", "surface/fusion/test_stereo_frames.py")
CUBES = ("kernels/test_marching_cubes.py",)
PHOTOS = ("surface/finish/test_photo_consistency.py",)
LOSS = ("kernels/test_photometric.py",)
ADAM = ("kernels/test_optimize.py",)


def _in(file: str, snippet: str, replacement: str, tests: tuple[str, ...]) -> Mutation:
    return Mutation(Edit(f"csrc/{file}", snippet, replacement), tests)


MUTATIONS = {
    # Blending in the order of centres.
    "median-gradient-beyond": _in(
        "raster/blend_center.h",
        "select(hit & (v_level < after), g_median",
        "select(hit & (v_level < t), g_median",
        CENTER,
    ),
    "distortion-without-opacity": _in(
        "raster/blend_center.h",
        "distortion[i] = through[i] * geo[kMoment2][i] - ",
        "distortion[i] = geo[kMoment2][i] - ",
        CENTER,
    ),
    "blend-after-the-stop": _in(
        "raster/blend_center.h", "const M hit = hits[k] & (t >= v_stop);", "const M hit = hits[k];", CENTER
    ),
    "thin-slope-series": _in(
        "raster/tile.h", "series(Real(-1.0 / 12), Real(1.0 / 240),", "series(Real(-1.0 / 12), Real(1.0 / 720),", CENTER
    ),
    # Blending in the order of entries.
    "entry-last-weight": _in(
        "raster/blend_sorted.h",
        "P.pair_weight[slot] = std::max(P.pair_weight[slot], max_lane(weight)), P.pair_pixels[slot] += count;",
        "P.pair_weight[slot] = max_lane(weight), P.pair_pixels[slot] += count;",
        LADDER,
    ),
    "affine-key-not-a-depth": _in(
        "primitives/polyhedron_project.h",
        "return nearest * (nearest > 0.0 ? splat(1 / longest) : splat(1.0)) - kDepthSlack",
        "return nearest - kDepthSlack",
        LADDER,
    ),
    # Blending by overlap.
    "overlap-variance": _in(
        "raster/blend_overlap.h", "fma(dz, dz, zero - length_here * length_here * slope)", "dz * dz", LADDER
    ),
    "overlap-median-edge": _in(
        "raster/blend_overlap.h",
        "edge = edge + select(crossed < V::set(Real(0.5)), pull, zero);",
        "edge = edge + pull;",
        LADDER,
    ),
    "overlap-count-after-the-stop": _in(
        "raster/blend_overlap.h", "popcount((steps & open & (now < c.t_in)", "popcount((steps & (now < c.t_in)", LADDER
    ),
    "overlap-median-normal": _in("raster/blend_overlap.h", "(of(c) - turned) * slow", "of(c) * slow", LADDER),
    "overlap-front-moment": _in("raster/blend_overlap.h", "fma(p1, sigma * X[2],", "fma(p1, sigma * X[1],", LADDER),
    "overlap-affine-distance": _in(
        "raster/blend_overlap.h", "kGeometry || Kind::kRayModel == RayModel::kAffine ?", "kGeometry ?", LADDER
    ),
    # Projection and its adjoint.
    "affine-length-gradient": _in(
        "primitives/polyhedron_project.h",
        "inverse_held + 2.0 * g_share * share",
        "inverse_held + g_share * share",
        LADDER,
    ),
    "affine-held-gradient": _in(
        "primitives/polyhedron_project.h",
        "c_grad[i] += free[i] ? to[i] : splat(0.0), c_grad[2] += free[i] ? splat(0.0) : to[i] * held[i] * inverse_z;",
        "c_grad[i] += free[i] ? to[i] : splat(0.0);",
        LADDER,
    ),
    "filter-scale-swapped": _in(
        "primitives/polyhedron_project.h",
        "g_scale_x += density_grad * density * scale_y, g_scale_y += density_grad * density * scale_x;",
        "g_scale_x += density_grad * density * scale_x, g_scale_y += density_grad * density * scale_y;",
        LADDER,
    ),
    "near-plane-cut": _in(
        "primitives/polyhedron_project.h",
        "(view.near - at[i][2]) / (at[j][2] - at[i][2])",
        "(view.near - at[j][2]) / (at[i][2] - at[j][2])",
        CENTER,
    ),
    "block-one-pixel-short": _in("primitives/primitive_pose.h", "double(kBlock - 1)", "double(kBlock - 2)", CENTER),
    "color-along-the-ray": _in(
        "primitives/primitive_pose.h", "(to_direction[t] - radial * direction[t][l])", "to_direction[t]", CENTER
    ),
    "rotation-length": _in(
        "primitives/primitive_pose.h",
        "(q_grad[k] - radial * f.q[k]) * inverse",
        "(q_grad[k] - radial * f.q[k])",
        CENTER,
    ),
    "third-degree-gradient": _in(
        "primitives/spherical_harmonics.h",
        "out[13][0] = -kSh3[2] * (4.0 * zz - 3.0 * xx - yy)",
        "out[13][0] = -kSh3[2] * (4.0 * zz - xx - yy)",
        CENTER,
    ),
    "octahedron-pull": _in(
        "primitives/octahedron.h",
        "(kRays == RayModel::kExact ? double(slot[9 + k]) : 0.0)",
        "0.0",
        CENTER,
    ),
    "tetrahedron-behind-near": _in(
        "primitives/tetrahedron.h", "center[2] + f.high_z > view.near", "center[2] > view.near", CENTER
    ),
    "gaussian-capped-alpha": _in(
        "primitives/gaussian.h", "free = hit & (m.alpha < V::set(Real(kLargestAlpha)));", "free = hit;", CENTER
    ),
    # The loss and the optimiser.
    "loss-weight-of-l1": _in("loss/image_kernels.h", "sign * V::load(weight + x))", "sign)", LOSS),
    "loss-tile-seam": _in(
        "loss/image_kernels.h", "outer_first = left > 0 ? first - kSsimAlign : first", "outer_first = first", LOSS
    ),
    "adam-negative-zero": _in(
        "loss/image_kernels.h", "std::bit_cast<uint32_t>(values[k]) << 1;", "std::bit_cast<uint32_t>(values[k]);", ADAM
    ),
    # Optical depth of segments.
    "segment-begin": _in(
        "surface/segment_kernel.cpp",
        "const SeenSolid& solid) {\n  D in = p.begin,",
        "const SeenSolid& solid) {\n  D in{},",
        SEGMENTS,
    ),
    "segment-cut-off": _in("surface/segment_kernel.cpp", "p.sum[l] < P.most ? p.sum[l] : P.most", "p.sum[l]", SEGMENTS),
    "segment-box-of-tetrahedra": _in(
        "surface/segment_depth.cpp",
        "box.low[k] = solid.center[k] + solid.slabs.low[k]",
        "box.low[k] = solid.center[k] - solid.slabs.high[k]",
        SEGMENTS,
    ),
    # Fusing depth maps.
    "fuse-grazed-reach": _in(
        "surface/fuse.cpp", "value > -rules.grazed && along > -rules.grazed_reach", "value > -rules.grazed", FUSING
    ),
    "fuse-behind": _in("surface/fuse.cpp", "std::clamp(2 + along", "std::clamp(1 + along", FUSING),
    "fuse-free-beside-outlines": _in(
        "surface/fuse.cpp", "inverse_depth > surfel.nearest ? surfel.free : 0", "surfel.free", FUSING
    ),
    "surfel-row-below": _in("surface/surfels.cpp", "row = y - 1; row <= y + 1;", "row = y - 1; row < y + 1;", FUSING),
    # Marching cubes.
    "cubes-fan": _in("surface/marching_cubes.cpp", "while (crosses_a_face())", "if (crosses_a_face())", CUBES),
    "cubes-negative-parent": _in(
        "surface/marching_cubes.cpp",
        "return found->second;\n      for (int64_t& x : at) x >>= 1;",
        "return found->second;\n      for (int64_t& x : at) x /= 2;",
        CUBES,
    ),
    # Photo-consistency.
    "photo-square-weight": _in(
        "surface/photo_consistency.cpp", "square[k] += weight * found * found", "square[k] += found * found", PHOTOS
    ),
    "photo-depth-slack": _in(
        "surface/photo_consistency.cpp", "slope = step + slope_across(", "slope = slope_across(", PHOTOS
    ),
    "photo-footprint-facing": _in(
        "surface/photo_consistency.cpp", "seen.at[2] / (focal * seen.facing)", "seen.at[2] / focal", PHOTOS
    ),
}


def edited(text: str, edit: Edit, what: str) -> str:
    """Return `text` with the edit; SystemExit if the snippet does not occur exactly once."""
    found = text.count(edit.snippet)
    if found != 1:
        raise SystemExit(f"mutate_core: the snippet of {what} is {found} times in {edit.file}, wanted once")
    return text.replace(edit.snippet, edit.replacement)


def write_if_changed(path: Path, text: str) -> None:
    """Write a file only if its text differs, so that unchanged files keep their modification time and are not
    recompiled."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


class Copy:
    """A copy of the core's sources and its build, in a separate folder."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self.folder, self.source, self.jobs = folder, folder / "source", jobs
        self.text = {
            str(path.relative_to(ROOT)): path.read_text()
            for path in (ROOT / "CMakeLists.txt", *sorted((ROOT / "csrc").rglob("*.*")))
        }
        copies = {name for text in self.text.values() for name in re.findall(r"\b(\w+)_v[24]\(\)", text)}
        self.flags = " ".join(f"-D{name}_v{level}={name}_v3" for name in sorted(copies) for level in (2, 4))
        for edit in REDUCTIONS:
            self.text[edit.file] = edited(self.text[edit.file], edit, "a reduction")
        for name, mutation in MUTATIONS.items():
            edited(self.text[mutation.edit.file], mutation.edit, name)
        for name, text in self.text.items():
            write_if_changed(self.source / name, text)

    def build(self) -> Path:
        options = [f"-DCMAKE_CXX_FLAGS=-w {self.flags}"]
        try:
            return build(self.folder / "build", self.jobs, options, self.source, capture_output=True, text=True)
        except subprocess.CalledProcessError as error:
            raise SystemExit(f"mutate_core: the build failed:\n{error.stdout[-3000:]}{error.stderr[-3000:]}") from None

    def first_failure(self, module: Path, tests: Sequence[str]) -> str | None:
        """Return the first failing test of these files, or the reason if they end otherwise; None if all pass."""
        arguments = [
            "-x",
            "-q",
            "-n0",
            "--tb=short",
            "-p",
            "no:cacheprovider",
            *(str(ROOT / "tests" / t) for t in tests),
        ]
        try:
            done = run_pytest(module, self.folder, arguments, {}, capture_output=True, text=True, timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            return f"not finished within {PATIENCE} s"
        (self.folder / "tests.log").write_text(done.stdout + done.stderr)
        if done.returncode == 0:
            return None
        failed = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
        if failed:
            return failed[1]
        if done.returncode < 0:
            return f"signal {-done.returncode}"
        raise SystemExit(f"mutate_core: pytest did not run:\n{(done.stdout + done.stderr)[-3000:]}")

    def noticed_by(self, mutation: Mutation) -> str | None:
        """Return the test that fails with the mutation, or None if it survives."""
        file = mutation.edit.file
        path = self.source / file
        path.write_text(edited(self.text[file], mutation.edit, file))
        try:
            return self.first_failure(self.build(), mutation.tests)
        finally:
            path.write_text(self.text[file])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="build in this folder and keep it (default: a temporary folder)"
    )
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="parallel compile jobs (default: %(default)s)")
    parser.add_argument(
        "--only", action="append", metavar="NAME", choices=MUTATIONS, help="run only this mutation; may be repeated"
    )
    parser.add_argument("--list", action="store_true", help="list the mutations and exit")
    options = parser.parse_args(arguments)
    chosen = {name: MUTATIONS[name] for name in options.only or MUTATIONS}
    if options.list:
        for name, mutation in chosen.items():
            print(f"{name:30} {mutation.edit.file}")
        return 0
    from linprim_geo.kernels import ops

    os.environ.pop("LINPRIM_GEO_ISA", None)
    if ops.instruction_set() not in ("v3", "v4"):
        print("mutate_core: this processor has no AVX2, for which the kernels are built", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="linprim-mutate-") as temporary:
        folder = options.keep.resolve() if options.keep else Path(temporary)
        begin = time.monotonic()
        copy = Copy(folder, options.jobs)
        failure = copy.first_failure(copy.build(), sorted({t for m in chosen.values() for t in m.tests}))
        if failure:
            print(f"mutate_core: a test fails without a mutation: {failure}", file=sys.stderr)
            return 2
        print(f"{'no mutation':30} {time.monotonic() - begin:4.0f} s  all tests pass", flush=True)
        noticed = 0
        for name, mutation in chosen.items():
            begin = time.monotonic()
            failure = copy.noticed_by(mutation)
            noticed += failure is not None
            said = f"killed by {failure}" if failure else "SURVIVED"
            print(f"{name:30} {time.monotonic() - begin:4.0f} s  {said}", flush=True)
    print(f"{noticed} of {len(chosen)} mutations are detected")
    return int(noticed < len(chosen))


if __name__ == "__main__":
    sys.exit(main())
