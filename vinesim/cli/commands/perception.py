"""``vinesim fuse`` and ``vinesim view``: their options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer


def fuse(
    tour: Annotated[
        pathlib.Path, typer.Argument(help="Folder of vinesim render --path, of vinesim render, or of vinesim dataset.")
    ],
    out: Annotated[pathlib.Path, typer.Option(help="PLY file to write: a coloured triangle mesh in metres.")],
    voxel: Annotated[float, typer.Option(help="Edge of a voxel [m].")] = 0.004,
    far: Annotated[float, typer.Option(help="Depth beyond which pixels are ignored [m].")] = 2.0,
    depth: Annotated[str, typer.Option(help="exact: true depth. measured: depth as the camera measures it.")] = "exact",
    views: Annotated[
        int | None,
        typer.Option(min=1, help="Leave out surface that fewer pictures see; by default 2, or 1 for a single picture."),
    ] = None,
    ids: Annotated[bool, typer.Option("--ids", help="Add the label of the object to every vertex.")] = False,
) -> None:
    """Fuse the RGB-D pictures of a tour into one surface (TSDF). Needs vinesim[perception].

    \b
    Examples:
      vinesim fuse tour --out vine.ply
      vinesim fuse tour --out stems.ply --voxel 0.002 --far 1 --ids
      vinesim fuse tour --out measured.ply --depth measured
    """
    from vinesim.cli.perception import fuse as run

    raise typer.Exit(run(tour, out=out, voxel=voxel, far=far, depth=depth, ids=ids, views=views))


def view(
    files: Annotated[
        list[pathlib.Path],
        typer.Argument(
            metavar="FILE",
            help="PLY, PCD, XYZ, PTS, STL or OBJ file. Or RGB-D pictures: MCAP file, rosbag2 folder, or folder of "
            "vinesim render or vinesim dataset.",
        ),
    ],
    out: Annotated[pathlib.Path | None, typer.Option(help="Write this PNG file instead of opening a window.")] = None,
    picture: Annotated[int, typer.Option(min=0, help="Index of the picture in a recording, tour or data set.")] = 0,
    image: Annotated[
        str | None, typer.Option(help="Topic of the colours in a recording; by default the only one of its kind.")
    ] = None,
    depth: Annotated[
        str | None, typer.Option(help="Topic of the depth in a recording; by default the only one of its kind.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(help="With --out: position of the camera, X,Y,Z [m]; by default the shape fills the picture."),
    ] = None,
    look: Annotated[
        str | None, typer.Option(help="With --out: the point it looks at, X,Y,Z [m]; by default the shape's middle.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(help="With --out: width and height of the picture, WxH [px]; by default 960x720.")
    ] = None,
) -> None:
    """Show a point cloud or a surface in Open3D's viewer, or draw it without a display. Needs vinesim[perception].

    \b
    Examples:
      vinesim view vine.ply
      vinesim view vine.ply --out vine.png
      vinesim view tour --picture 3
      vinesim view pictures.mcap --picture 10 --out cloud.png
    """
    from vinesim.cli.perception import view as run

    raise typer.Exit(run(files, out=out, picture=picture, at=at, look=look, size=size, image=image, depth=depth))
