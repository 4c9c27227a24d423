"""``make validation``: plots the comparisons of tests/laws and writes their figures into docs/validation.md.

Everything comes from the functions that the tests call: ``tests/support/beam_theory.py`` and the scenes of
``tests/support/contact_scenes.py``.
"""

from __future__ import annotations

import datetime
import os
import pathlib
import platform

import matplotlib
import mujoco
import numpy as np
import warp as wp

from tests.laws import test_integration, test_rod_in_space
from tests.physics import test_cutting
from tests.support import beam_theory
from tests.support.contact_forces import force_on
from tests.support.contact_scenes import bunch_scene, grasp, gripper, held_point
from vinesim.bench.mujoco_reference import MujocoScene
from vinesim.interaction import cutting_force
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

matplotlib.use("Agg")
from matplotlib import pyplot as plt

ROOT = pathlib.Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
PAGE = ROOT / "docs" / "validation.md"
BEGIN = "<!-- laws: written by make validation -->"
END = "<!-- laws end -->"
INK = "#2b2b2b"
GRAPE = "#6a2c70"
LEAF = "#4f7942"
WOOD = "#b5651d"
GREY = "#9a9a9a"
COLOURS = (GRAPE, LEAF, WOOD, "#2a6f97")

plt.rcParams |= {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "savefig.dpi": 130,
    "axes.grid": True,
    "grid.color": "#ececec",
}

Table = list[str]


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    """Markdown."""
    return ["| " + " | ".join(cells) + " |" for cells in (head, ("---",) * len(head), *rows)]


def save(figure: plt.Figure, name: str) -> None:
    figure.savefig(PICTURES / f"laws-{name}.png", bbox_inches="tight", facecolor="white")
    plt.close(figure)


def elastica() -> Table:
    """Canes at rest over alpha: bodies on the elastica, and how far their tips are from it."""
    figure, (shapes, errors) = plt.subplots(1, 2, figsize=(11, 4.6), width_ratios=(1.15, 1), layout="constrained")
    loads = (0.5, 1.0, 2.0, 3.5, 6.6, 10.0, 20.0)
    drawn = [beam_theory.of_load(alpha, 1.0, beta=0.3) for alpha in loads]
    plants = beam_theory.settle([beam.tree(i) for i, beam in enumerate(drawn)])
    colours = plt.cm.viridis(np.linspace(0.0, 0.85, len(loads)))
    for i, (alpha, beam, colour) in enumerate(zip(loads, drawn, colours, strict=True)):
        line = beam_theory.elastica_line(beam)
        shapes.plot(*line, color=colour, lw=1.4)
        joints = plants.state.body_q[plants.model.bodies_of(i)][:, [0, 2]] - np.array([0.0, beam_theory.HEIGHT])
        shapes.plot(*joints.T, "o", ms=3.2, color=colour)
        shapes.annotate(f"{alpha:g}", line[:, -1], xytext=(5, -4), textcoords="offset points", fontsize=9)
    shapes.set(aspect="equal", xlabel="forward [m]", ylabel="up [m]", xlim=(-0.03, 1.12))
    shapes.set_title("elastica (lines) and 16 bodies (dots) under a tip load, by alpha")

    cases, truth, measured = beam_theory.elastica_sweep()
    alpha, share, angle = np.array(cases).T
    straight = np.stack([np.cos(angle), np.sin(angle)], 1)
    off = 100 * np.linalg.norm(measured - truth, axis=1) / np.linalg.norm(truth - straight, axis=1)
    kinds = ((0.0, "own weight", LEAF), (0.5, "both", WOOD), (1.0, "tip load", GRAPE))
    for which, name, colour in kinds:
        here = share == which
        errors.plot(alpha[here], off[here], "o", ms=4, alpha=0.75, color=colour, label=name)
    errors.axhline(0.5, color=INK, lw=1, ls="--")
    errors.annotate("gate", (0.05, 0.5), xytext=(0, 4), textcoords="offset points", fontsize=9)
    errors.set(xscale="log", ylim=(0, 0.6), xlabel="alpha = (P + W) L²/EI", ylabel="tip off, % of its travel")
    errors.set_title(f"{len(cases)} canes clamped at -57 to 57 degrees")
    errors.legend(loc="lower left")
    save(figure, "elastica")
    rows = [(name, f"{off[share == which].max():.2f} %") for which, name, _ in kinds]
    return table((f"elastica, {len(cases)} canes, alpha 0.05 to 20", "worst tip, share of its travel"), rows)


def convergence() -> Table:
    """Errors over pieces and over time steps, with the slope of two."""
    figure, (pieces, steps) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    rows = []
    joined = beam_theory.errors_over_pieces_of_joined()
    cases = [*beam_theory.errors_over_pieces().items(), *joined.items()]
    for (case, errors), colour in zip(cases, COLOURS * 2, strict=True):
        slope = beam_theory.order([1 / n for n in beam_theory.PIECES], errors)
        style = "s:" if case in joined else "o-"
        pieces.loglog(beam_theory.PIECES, 1e3 * errors, style, color=colour, ms=4, label=f"{case}: {slope:.2f}")
        rows.append((case, *(f"{1e3 * e:.3g}" for e in errors), f"{slope:.2f}"))
    n = np.array(beam_theory.PIECES, float)
    pieces.loglog(n, 60 * (n / n[0]) ** -2, color=GREY, ls="--", lw=1)
    pieces.annotate("slope 2", (n[2], 60 * (n[2] / n[0]) ** -2), xytext=(6, 4), textcoords="offset points", fontsize=9)
    pieces.set(xlabel="bodies of a cane", ylabel="tip off [mm]", xticks=n, xticklabels=beam_theory.PIECES)
    pieces.minorticks_off()
    pieces.set_title("resting tip against the elastica: order")
    pieces.legend(fontsize=7, loc="lower left")

    over_dt = beam_theory.errors_over_dt()
    dt = 1e3 * np.array(beam_theory.STEPS)
    slope = beam_theory.order(beam_theory.STEPS, over_dt["frequency"])
    steps.loglog(dt, 100 * over_dt["frequency"], "o", color=GRAPE, label=f"frequency, % (order {slope:.2f})")
    steps.loglog(dt, 100 * over_dt["theory"], color=GRAPE, lw=1, ls="--", label="(ω dt)² / 12, the trapezoidal rule's")
    slope_tip = beam_theory.order(beam_theory.STEPS, over_dt["tip"])
    steps.loglog(dt, 1e3 * over_dt["tip"], "s-", color=LEAF, label=f"tip after 0.5 s, mm (order {slope_tip:.2f})")
    steps.set(xlabel="dt [ms]", ylabel="error", xticks=dt, xticklabels=[f"{x:g}" for x in dt])
    steps.minorticks_off()
    steps.set_title("a cane of 5 Hz, phi 1/2")
    steps.legend(fontsize=9)
    save(figure, "convergence")
    lines = table(("tip off [mm] with so many bodies", *map(str, beam_theory.PIECES), "order"), rows)
    head = ("phi 1/2, dt [ms]", *(f"{x:g}" for x in dt), "order")
    lines += [
        "",
        *table(
            head,
            [
                ("frequency off [%]", *(f"{100 * e:.3g}" for e in over_dt["frequency"]), f"{slope:.2f}"),
                ("tip off after 0.5 s [mm]", *(f"{1e3 * e:.3g}" for e in over_dt["tip"]), f"{slope_tip:.2f}"),
            ],
        ),
    ]
    return lines


def damping() -> Table:
    """Requested and measured damping ratio, at 100 Hz and the default phi."""
    measured, frequency, floor = beam_theory.damping_sweep()
    requested = np.array(beam_theory.ZETAS)
    figure, axes = plt.subplots(figsize=(5.4, 4.4), layout="constrained")
    axes.plot([0, 0.21], [0, 0.21], color=GREY, lw=1, ls="--")
    axes.fill_between([0, 0.21], [-0.005, 0.205], [0.005, 0.215], color=GREY, alpha=0.18, lw=0, label="gate: 0.005")
    axes.axhline(floor[0], color=WOOD, lw=1, label=f"floor {floor[0]:.4f} (2.8 Hz, phi 0.55)")
    axes.plot(requested, measured, "o", color=GRAPE, ms=6, label="seen")
    axes.set(xlabel="damping ratio asked", ylabel="damping ratio seen", xlim=(0, 0.21), ylim=(0, 0.21), aspect="equal")
    axes.set_title("first mode of a cane, 100 Hz")
    axes.legend(loc="upper left")
    save(figure, "damping")
    lines = table(
        ("damping ratio asked", *(f"{z:g}" for z in requested)),
        [("seen", *(f"{z:.4f}" for z in measured)), ("frequency", *(f"{100 * (f - 1):+.2f} %" for f in frequency))],
    )
    lines += ["", *first_modes()]
    f_seen, f_truth = beam_theory.measured_frequencies()
    off = [f"{100 * (a / b - 1):+.2f} %" for a, b in zip(f_seen, f_truth, strict=True)]
    return [*lines, "", *table(("frequency at 1 ms", "first", "second", "third"), [("off", *off)])]


def first_modes() -> Table:
    """First mode of stiff canes at 100 Hz and the default phi, with whole steps and with substeps."""
    zeta = 0.12
    substeps, expected, *after = test_integration.first_modes(zeta)
    _, _, *before = test_integration.first_modes(zeta, substeps=False)
    rows = [("substeps", *map(str, substeps))]
    for name, (frequency, damping) in (("whole steps", before), ("substeps as above", after)):
        rows.append(
            (f"{name}: frequency", *(f"{100 * (f / g - 1):+.2f} %" for f, g in zip(frequency, expected, strict=True)))
        )
        rows.append((f"{name}: damping ratio, {zeta} asked", *(f"{z:.4f}" for z in damping)))
    return table(("first mode [Hz]", *(f"{f:.1f}" for f in expected)), rows)


def grasped() -> Table:
    """A bunch grasped, lifted, moved, pulled, released: vinesim, and the same scene entirely in MuJoCo."""
    model, body, middle = bunch_scene()
    ours = Physics(model)
    reference = MujocoScene(model, [gripper(middle)])
    ours.add_robot(gripper(middle))
    place = np.zeros((2, 800, 3))
    force = np.zeros((2, 800))
    for tick in range(800):
        target, pull = grasp(0.01 * tick)
        for rigid in (ours.rigid, reference.rigid):
            rigid.command("grip", target)
            rigid.apply_wrench("grip", "hand", np.array([0.0, 0.0, pull]))
        ours.step()
        reference.step()
        place[:, tick] = [held_point(model, q, body) for q in (ours.snapshot().body_q[body], reference.body_pose(body))]
        force[:, tick] = abs(force_on(ours, "left")[1]), abs(reference.contact_force_on("left")[1])
    time = 0.01 * np.arange(800)
    figure, (position, press) = plt.subplots(2, 1, figsize=(8.5, 5.4), sharex=True, layout="constrained")
    for axis, name, colour in ((1, "aside", LEAF), (2, "up", GRAPE)):
        position.plot(time, 1e3 * (place[1, :, axis] - place[1, 0, axis]), color=colour, lw=3.5, alpha=0.35)
        position.plot(time, 1e3 * (place[0, :, axis] - place[1, 0, axis]), color=colour, lw=1.2, label=name)
    position.set_ylabel("bunch [mm]")
    position.set_title("a bunch grasped, lifted, moved, pulled, let go: vinesim (thin), all in MuJoCo (broad)")
    position.legend(loc="upper left")
    press.plot(time, force[1], color=WOOD, lw=3.5, alpha=0.35)
    press.plot(time, force[0], color=WOOD, lw=1.2)
    press.set(xlabel="time [s]", ylabel="left finger [N]", ylim=(0, 60))
    save(figure, "grasp")
    off = np.linalg.norm(place[0] - place[1], axis=1)[:640].max()
    held = slice(250, 590)
    ratio = force[0, held].mean() / force[1, held].mean() - 1
    return table(
        ("grasp against all in MuJoCo", ""),
        [("bunch while held, at worst", f"{1e3 * off:.2f} mm"), ("mean finger force", f"{100 * ratio:+.2f} %")],
    )


def energy() -> Table:
    """Energy of undamped canes over a minute."""
    figure, axes = plt.subplots(figsize=(7.5, 3.6), layout="constrained")
    rows = []
    kicks = {"up and down": (0.0, 0.05, 0.0), "slantwise": (0.0, 0.04, 0.03), "aside": (0.0, 0.0, 0.05)}
    canes = [(name, test_rod_in_space.drawn_cane(), np.array(kick)) for name, kick in kicks.items()]
    canes.append(("aside, 100 g on the tip", test_rod_in_space.loaded_cane(0.1), np.array([0.0, 0.0, 0.02])))
    for (name, cane, kick), colour in zip(canes, COLOURS, strict=True):
        measured, fastest = test_rod_in_space.drift(cane, kick)
        share = 100 * (measured[-100:].mean() / measured[:100].mean() - 1)
        axes.plot(0.05 * np.arange(len(measured)), 100 * (measured / measured[0] - 1), color=colour, lw=1.2, label=name)
        rows.append((name, f"{fastest:.2f} rad/s", f"{share:+.2f} %"))
    axes.axhspan(-1, 1, color=GREY, alpha=0.18, lw=0, label="gate: 1 %")
    axes.set(xlabel="time [s]", ylabel="energy, % off", ylim=(-2, 2))
    axes.set_title("undamped canes, phi 1/2, 100 Hz")
    axes.legend(ncols=4, loc="upper right", fontsize=9)
    save(figure, "energy")
    return table(("energy over 60 s, phi 1/2", "fastest body", "drift"), rows)


def machine() -> str:
    """One line: date, processor, versions."""
    cpu = next(
        (line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")),
        platform.machine(),
    )
    today = datetime.date.today().isoformat()
    return (
        f"{today}, {len(os.sched_getaffinity(0))} cores of {cpu}, Python {platform.python_version()}, "
        f"Warp {wp.__version__}, MuJoCo {mujoco.__version__}"
    )


PUBLISHED_CUTS = (
    # name, strength [Pa], diameter [m], force [N], energy [J], share of the energy; whether force gives the diameter
    ("Tannat, dormant", 13.94e6, 9.2e-3, 981.65, 2.39, cutting_force.DORMANT_ENERGY_SHARE, False),
    ("Cabernet Franc, dormant", 21.68e6, 9.2e-3, 1397.60, 3.68, cutting_force.DORMANT_ENERGY_SHARE, False),
    ("Okuzgozu, veraison, mean", 13.16e6, 8.665e-3, 774.55, 5.94, cutting_force.CHORD_ENERGY_SHARE, True),
    ("Okuzgozu, harvest, mean", 9.63e6, 8.665e-3, 568.42, 3.33, cutting_force.CHORD_ENERGY_SHARE, True),
    ("Okuzgozu, internode 1", 13.16e6, 6.107e-3, 385.52, 1.85, cutting_force.CHORD_ENERGY_SHARE, True),
    ("Okuzgozu, internode 5", 13.16e6, 9.814e-3, 995.49, 7.34, cutting_force.CHORD_ENERGY_SHARE, True),
    ("Bogazkere, flat blade", 9.34e6, 6.0e-3, 263.50, None, cutting_force.CHORD_ENERGY_SHARE, True),
    ("Bogazkere, serrated blade", 15.59e6, 6.0e-3, 440.50, None, cutting_force.CHORD_ENERGY_SHARE, True),
)


def cut(diameter: float, strength: float, share: float) -> tuple[float, float]:
    """Largest force [N] and energy [J] of a blade that cuts a cane in the simulation."""
    parameters = PhysicsParameters(cutting_strength=strength, cutting_energy_share=share)
    physics, blade, _ = test_cutting.on_cane(radius=0.5 * diameter, speed=0.1, parameters=parameters)
    (event,) = test_cutting.close(physics, blade)
    assert event.outcome == "cut"
    return event.force, event.energy


def cutting() -> Table:
    """Blades in the simulation against published cutting forces and energies."""
    figure, (by_diameter, by_depth) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    diameters = np.linspace(4e-3, 11e-3, 60)
    woods = {13.94e6: WOOD, 21.68e6: INK, 13.16e6: LEAF, 9.63e6: GRAPE, 9.34e6: GREY, 15.59e6: "#2a6f97"}
    for strength, colour in woods.items():
        force = [cutting_force.shear_force(d, strength) for d in diameters]
        by_diameter.plot(1e3 * diameters, force, color=colour, lw=1)
    rows = []
    for name, strength, diameter, force, energy, share, is_implied in PUBLISHED_CUTS:
        found, work = cut(diameter, strength, share)
        by_diameter.plot(1e3 * diameter, force, "s" if not is_implied else "d", color=woods[strength], ms=6, label=name)
        by_diameter.plot(1e3 * diameter, found, "x", color=woods[strength], ms=6)
        rows.append(
            (
                name,
                f"{1e-6 * strength:.2f}",
                f"{1e3 * diameter:.2f}" + (" (implied)" if is_implied else ""),
                f"{force:,.0f}",
                f"{found:,.0f} ({100 * (found / force - 1):+.1f} %)",
                "" if energy is None else f"{energy:.2f}",
                "" if energy is None else f"{work:.2f} ({100 * (work / energy - 1):+.0f} %)",
            )
        )
    by_diameter.set(xlabel="diameter [mm]", ylabel="largest force [N]", ylim=(0, None))
    by_diameter.set_title("published (diamonds: diameter implied by force), blades (crosses)")
    by_diameter.legend(fontsize=7.5, loc="upper left")

    for share, colour, name in (
        (cutting_force.CHORD_ENERGY_SHARE, LEAF, "cane with leaves"),
        (cutting_force.DORMANT_ENERGY_SHARE, WOOD, "dormant cane"),
    ):
        parameters = PhysicsParameters(cutting_energy_share=share)
        physics, blade, _ = test_cutting.on_cane(radius=0.005, speed=0.02, parameters=parameters)
        blade.close()
        seen = []
        while blade.closing:
            before, depth = blade.energy, 0.01 - blade.gap
            physics.step()
            seen.append((0.5 * (depth + 0.01 - blade.gap), (blade.energy - before) / 2e-4))
        mid, force = np.array([row for row in seen if 0.0 < row[0] < 0.01]).T
        by_depth.plot(1e3 * mid, force, "o", ms=3, color=colour, label=f"{name}: work by way of a blade")
        line = np.linspace(0.0, 1.0, 200)
        law = cutting_force.shear_force(0.01) * cutting_force.force_share(line, share)
        by_depth.plot(10 * line, law, color=colour, lw=1)
    by_depth.set(xlabel="depth of the edges in 10 mm [mm]", ylabel="force [N]", ylim=(None, 1300))
    by_depth.set_title("force over depth: law (lines) and blades (dots)")
    by_depth.legend(fontsize=8, loc="upper center")
    save(figure, "cutting")
    return table(
        ("wood", "strength [MPa]", "diameter [mm]", "published force [N]", "blade", "published energy [J]", "blade"),
        rows,
    )


def _lines(path: str) -> list[str]:
    file = pathlib.Path(path)
    return file.read_text().splitlines() if file.exists() else []


def main() -> None:
    """Draw all and put the tables between the markers."""
    PICTURES.mkdir(exist_ok=True)
    lines = [f"By `make validation`: {machine()}."]
    sections = (
        ("elastica", elastica, "canes at rest over alpha"),
        ("convergence", convergence, "convergence in bodies and dt"),
        ("damping", damping, "damping ratio asked against seen"),
        ("energy", energy, "energy over a minute"),
        ("grasp", grasped, "a grasp against the same scene in MuJoCo"),
        ("cutting", cutting, "cutting forces of blades and of papers"),
    )
    for name, draw, text in sections:
        print(name, flush=True)
        lines += ["", f"![{text}](pictures/laws-{name}.png)", "", *draw()]
    before, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text("\n".join([before + BEGIN, "", *lines, "", END + rest.split(END)[1]]))


if __name__ == "__main__":
    main()
