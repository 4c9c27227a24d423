"""``vinesim scene show``, ``vinesim export``, ``vinesim render`` and ``vinesim dataset``: their options."""

from __future__ import annotations

import pathlib
from typing import Annotated

import typer

from vinesim.cli.commands.options import Camera, Colour, Device, ImageSize, Seed, Sensors


def scene_show(
    file: Annotated[str, typer.Argument(help="A scene file, or cordon, demo, harvest, slope, tendone, vsp.")],
    seed: Seed = None,
    out: Annotated[pathlib.Path | None, typer.Option(help="Picture to write; by default NAME.png.")] = None,
) -> None:
    """Print the contents of a scene, and draw it.

    \b
    Examples:
      vinesim scene show demo
      vinesim scene show my-block.toml --seed 4 --out block.png
    """
    from vinesim.cli.scene import show

    raise typer.Exit(show(file, seed, out))


def scene_import_plant(
    file: Annotated[
        pathlib.Path, typer.Argument(help="MTG (.mtg), PLY skeleton (.ply), cylinders (.txt) or Helios XML (.xml).")
    ],
    out: Annotated[pathlib.Path | None, typer.Option(help="TOML file to write; by default NAME.toml.")] = None,
    unit: Annotated[str, typer.Option(help="Unit of coordinates: m, cm or mm.")] = "m",
    diameter_unit: Annotated[
        str | None, typer.Option(help="Unit of diameters and radii; by default as --unit.")
    ] = None,
    plants: Annotated[str, typer.Option(help="Plant parameters that replace missing numbers.")] = "vine",
    slack: Annotated[
        bool, typer.Option("--slack", help="The file shows the plant without its weight: it will sag.")
    ] = False,
    piece: Annotated[float, typer.Option(help="Length of the rigid bodies into which wood is divided [m].")] = 0.06,
    old_wood: Annotated[
        float | None, typer.Option(help="Wood thicker than this [m] is rigid; 0.01575 with the parameters vine.")
    ] = None,
) -> None:
    """Convert a plant of another program to a file that scenes load. Missing numbers are filled in and marked.

    \b
    Examples:
      vinesim scene import-plant examples/plants/vine.mtg
      vinesim scene import-plant tree.ply --unit cm --out tree.toml --slack
    """
    from vinesim.cli.scene import write_imported_plant

    code = write_imported_plant(
        file,
        out,
        unit=unit,
        diameter_unit=diameter_unit,
        plants=plants,
        shape="slack" if slack else "drawn",
        piece=piece,
        old_wood=old_wood,
    )
    raise typer.Exit(code)


def export(
    scene: Annotated[str, typer.Argument(help="A scene file, or demo, harvest, tendone, vsp.")],
    out: Annotated[
        pathlib.Path,
        typer.Option(help="File to write; its suffix chooses the format: .xml (MJCF), .urdf, .usda, .usdc or .usd."),
    ],
    seed: Seed = None,
    leaves: Annotated[
        bool, typer.Option("--leaves", help="Draw the leaves. They do not collide, and make the file twice as large.")
    ] = False,
    robot: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME@X,Y,YAW", help="A robot at rest there [m, rad]; may be repeated. In MJCF only."),
    ] = None,
) -> None:
    """Write a vineyard for another simulator: bodies on hinges with springs, wood, wires, ground, boxes.

    Masses, the equilibrium under gravity and the frequencies of small vibrations are those of vinesim. A URDF has the
    springs as elements that Gazebo alone reads. OpenUSD needs vinesim[export].

    \b
    Examples:
      vinesim export demo --out vineyard.xml
      vinesim export demo --robot my.urdf@2.5,0.2,1.57 --out vineyard.xml
      vinesim export vsp --seed 4 --out vsp.usdc
      vinesim export my-block.toml --leaves --out block.urdf
    """
    from vinesim.cli.scene import export_scene

    raise typer.Exit(export_scene(scene, seed, out, leaves, robot or []))


def render(
    scene: Annotated[str, typer.Argument(help="A scene file, or cordon, demo, harvest, slope, tendone, vsp.")],
    at: Annotated[str | None, typer.Option(help="Position of the camera, X,Y,Z [m].")] = None,
    look: Annotated[str | None, typer.Option(help="The point it looks at, X,Y,Z [m].")] = None,
    path: Annotated[
        pathlib.Path | None,
        typer.Option(help="Several viewpoints: CSV or JSON with x, y, z, look_x, look_y, look_z [m]."),
    ] = None,
    camera: Camera = "d435",
    size: ImageSize = None,
    seed: Seed = None,
    hour: Annotated[
        float | None, typer.Option(min=0.0, max=24.0, help="Solar time [h], instead of the scene's own sun.")
    ] = None,
    palette: Annotated[
        str | None, typer.Option(help="Colours of the vineyard: a palette's name or file, instead of the scene's own.")
    ] = None,
    time: Annotated[float, typer.Option(min=0.0, help="Simulated time [s]; determines wind and sun.")] = 0.0,
    out: Annotated[pathlib.Path, typer.Option(help="Folder for the picture and its ground truth.")] = pathlib.Path(
        "render"
    ),
    robot: Annotated[
        list[str] | None, typer.Option(help="NAME@X,Y[,YAW]: a robot at this place [m, rad]; may be repeated.")
    ] = None,
    person: Annotated[
        list[str] | None,
        typer.Option(help="X,Y[,YAW][,POSTURE]: a person who stands, picks, reaches, points, waves, carries or walks."),
    ] = None,
    crate: Annotated[
        list[str] | None, typer.Option(help="X,Y[,YAW[,FILL]]: a crate, filled with bunches from 0 to 1.")
    ] = None,
    sensor: Sensors = None,
    colour: Colour = "camera",
    velocity: Annotated[
        str | None,
        typer.Option(help="VX,VY,VZ[,WX,WY,WZ]: motion of the camera [m/s, rad/s]; blurs and shears the picture."),
    ] = None,
    device: Device = "cpu",
) -> None:
    """Render pictures with their ground truth: ids, masks, boxes, berries, cut points.

    Writes rgb.png, depth.png (exact depth, 16 bits, mm), measured.png (depth as the camera measures it), labels.png
    (id = R + 256 G + 65536 B), overlay.png, camera.json and truth.json; with --path into folders 0000, 0001, ...
    After an interruption the same command with --path continues. Bunches in a crate were picked from the nearest
    vines.

    \b
    Examples:
      vinesim render demo --at 0.4,1.2,1.3 --look 3,1,1.7
      vinesim render demo --path viewpoints.csv --out tour
      vinesim render demo --at 0.4,1.2,1.3 --look 3,1,1.7 --sensor multispectral:rededge_mx
      vinesim render vsp --camera pinhole --at 1,-1.2,1.1 --look 1,0,1 --size 1280x960 --seed 4 --out shot
      vinesim render harvest --at 0,0.15,1.35 --look 2.6,0.35,1 --robot vinebot@2.9,1,-2.5 --person 2.2,-0.28,2.3,pick
      --crate 1.8,0.75,0,0.4
    """  # keep a long command line whole, so that it can be copied
    from vinesim.cli.render import run

    code = run(
        scene,
        camera=camera,
        at=at,
        look=look,
        path=path,
        size=size,
        hour=hour,
        palette=palette,
        time=time,
        seed=seed,
        out=out,
        device=device,
        robots=robot or (),
        people=person or (),
        crates=crate or (),
        sensors=sensor or (),
        colour=colour,
        velocity=velocity,
    )
    raise typer.Exit(code)


def dataset(
    images: Annotated[
        int, typer.Option(min=1, max=999_999, help="Number of images, at least as many as OUT contains.")
    ],
    out: Annotated[pathlib.Path, typer.Option(help="Folder of the data set; an unfinished data set is continued.")],
    mix: Annotated[
        str | None,
        typer.Option(help="A mix file, or the name of a shipped mix: around, default. With --scene: around."),
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="A scene file or the name of a shipped scene, instead of the scenes of the mix.")
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same images.")] = 0,
    camera: Annotated[
        str | None, typer.Option(help="A camera file, or d435, pinhole, instead of the cameras of the mix.")
    ] = None,
    sensor: Sensors = None,
    colour: Colour = "camera",
    size: ImageSize = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, max=256, help="Number of processes; by default half the number of cores, or one per core with a GPU."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a Dask scheduler whose workers render; they must have access to OUT. Needs vinesim[dask]."
        ),
    ] = None,
    device: Device = "cpu",
    actors: Annotated[
        float | None,
        typer.Option(help="Share of the images with people, robots, crates and wind, instead of the mix's; 0: vines."),
    ] = None,
    negatives: Annotated[
        float | None,
        typer.Option(help="Share of the images in which no bunch is visible, with empty labels, instead of the mix's."),
    ] = None,
    segmentation: Annotated[
        str, typer.Option(help="Masks in COCO: polygons, rle (a list of run lengths) or compressed (RLE as text).")
    ] = "polygons",
    yolo: Annotated[
        str, typer.Option(help="Labels for YOLO: detect (boxes), segment (polygons) or pose (boxes and cut points).")
    ] = "detect",
    semantic: Annotated[bool, typer.Option("--semantic", help="Write an image of each pixel's class, too.")] = False,
    sequence: Annotated[
        int | None,
        typer.Option(
            min=2,
            max=10_000,
            help="Frames of a camera that drives along a row, with tracks and optical flow.",
        ),
    ] = None,
) -> None:
    """Render random pictures of random vineyards with their ground truth: COCO with masks, YOLO, depth, ids, poses.

    Scenes, vines, leaves, varieties, ripeness, sun, cameras and viewpoints are drawn from a mix, a TOML file, and
    actors and ripeness at random. With --scene alone all pictures are of that scene, from all sides of its bunches.
    After an interruption the same command continues, and renders deleted or truncated images again. A later run may
    ask for more images; fewer are refused. It may also ask for other masks and labels, which are made without
    rendering. The five images of a vineyard are in one split. Of every ten
    vineyards the second is for validation and the third for tests; the others are for training.

    \b
    Examples:
      vinesim dataset --images 1000 --out grapes
      vinesim dataset --images 1000 --out grapes --yolo segment
      vinesim dataset --images 100000 --out /shared/grapes --scheduler tcp://HOST:8786
      vinesim dataset --images 200 --out vsp --scene vsp --seed 3 --camera pinhole --size 320x240 --workers 4
      vinesim dataset --images 300 --out drives --sequence 30
    """
    options = dict(locals())
    from vinesim.cli.dataset import run

    raise typer.Exit(run(**options))
