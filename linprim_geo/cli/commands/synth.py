"""The command synth: photographs of a surface that is known."""

from __future__ import annotations

import argparse

from linprim_geo.cli.options import AddCommand, length, not_negative, pair, positive, size, whole


def add(command: AddCommand) -> None:
    sub = command("synth", run, "render posed images, depth, normals and points of a mesh or a built-in scene")
    sub.add_argument("output", metavar="OUT", help="folder to make")
    shape = sub.add_mutually_exclusive_group()
    shape.add_argument("--scene", choices=("cad", "smooth", "room", "wires"), help="built-in (default cad)")
    shape.add_argument("--mesh", metavar="FILE", help="any mesh with a texture or vertex colours")
    sub.add_argument("--views", type=positive, default=60, metavar="N", help="training views (default 60)")
    sub.add_argument("--test-views", type=whole, default=12, metavar="N", help="held-out views (default 12)")
    sub.add_argument("--size", type=size, default=(320, 320), metavar="WxH", help="pixels (default 320x320)")
    paths = ("orbit", "hemisphere", "sphere", "arc", "inside-out")
    sub.add_argument("--path", choices=paths, help="of the cameras (default: what suits the scene)")
    sub.add_argument("--fov", type=length, metavar="DEGREES", help="horizontal (default 45, inside 75)")
    sub.add_argument("--distance", type=length, metavar="LENGTH", help="from the middle, in the mesh's unit")
    text = "from the middle of the image, in pixels (default 0,0); a negative one is written --...=-5,3"
    sub.add_argument("--principal-point-offset", type=pair, default=(0.0, 0.0), metavar="X,Y", help=text)
    sub.add_argument("--shading", choices=("albedo", "shaded"), default="albedo", help="default albedo")
    sub.add_argument("--background", metavar="COLOR", help="transparent, black, white or r,g,b in [0,1]")
    sub.add_argument("--points", type=whole, default=20_000, metavar="N", help="on it (default 20000)")
    text = "standard deviation per axis of the points, in the mesh's unit (default 0)"
    sub.add_argument("--point-noise", type=not_negative, default=0.0, metavar="LENGTH", help=text)
    sub.add_argument("--supersample", type=positive, default=3, metavar="K", help="K*K rays a pixel (default 3)")
    sub.add_argument("--depth-format", choices=("png", "npy"), default="png", help="default png")
    text = "contrast of a built-in scene's texture (default 1)"
    sub.add_argument("--detail", type=not_negative, default=1.0, metavar="X", help=text)
    text = "gains of the training photographs vary by up to exp(X) each way (default 0)"
    sub.add_argument("--exposure-drift", type=not_negative, default=0.0, metavar="X", help=text)
    text = "k1 of a lens with radial distortion (default 0); a negative one is written --...=-0.1"
    sub.add_argument("--distortion", type=float, default=0.0, metavar="K1", help=text)
    text = "strength of highlights that move with the camera (default 0)"
    sub.add_argument("--specular", type=not_negative, default=0.0, metavar="X", help=text)
    text = "every third camera has X times the focal length (default 1)"
    sub.add_argument("--zoom", type=length, default=1.0, metavar="X", help=text)
    text = "stand it on a table X times as wide as it is (default 0, none)"
    sub.add_argument("--table", type=not_negative, default=0.0, metavar="X", help=text)
    text = "a room at infinity, drawn by seed N, in place of a background"
    sub.add_argument("--environment", type=whole, metavar="N", help=text)
    text = "of azimuth that the path arc covers (default 300)"
    sub.add_argument("--arc", type=length, metavar="DEGREES", help=text)
    text = "standard deviation of sensor noise at middle grey, in units of 1/255 (default 0)"
    sub.add_argument("--noise", type=not_negative, default=0.0, metavar="X", help=text)
    text = "photographs as .jpg of this quality (default 0, .png)"
    sub.add_argument("--jpeg", type=whole, default=0, metavar="QUALITY", help=text)
    sub.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of everything random (default 0)")
    sub.add_argument("--threads", type=whole, default=0, metavar="N", help="0 uses every core (default)")
    sub.add_argument("--overwrite", action="store_true", help="replace OUT if synth has made it")


def run(parsed: argparse.Namespace) -> dict:
    from linprim_geo.synthetic.synth import synthesize

    # What is not said is left to `synthesize`, which knows what suits the scene.
    chosen = {"shape": parsed.scene, "mesh": parsed.mesh, "path": parsed.path, "fov": parsed.fov}
    chosen |= {"distance": parsed.distance, "background": parsed.background}
    chosen |= {"environment": parsed.environment, "arc": parsed.arc}
    return synthesize(
        parsed.output,
        views=parsed.views,
        test_views=parsed.test_views,
        size=parsed.size,
        shading=parsed.shading,
        points=parsed.points,
        point_noise=parsed.point_noise,
        supersample=parsed.supersample,
        depth_format=parsed.depth_format,
        principal_point_offset=parsed.principal_point_offset,
        detail=parsed.detail,
        exposure_drift=parsed.exposure_drift,
        distortion=parsed.distortion,
        specular=parsed.specular,
        zoom=parsed.zoom,
        table=parsed.table,
        noise=parsed.noise,
        jpeg=parsed.jpeg,
        seed=parsed.seed,
        threads=parsed.threads,
        overwrite=parsed.overwrite,
        **{name: value for name, value in chosen.items() if value is not None},
    )
