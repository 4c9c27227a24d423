"""Events of the vineyard as rows for JSON: what left its plant or gave, how blades closed, what happened to the fruit.

Rows come from the client that simulated the event. Other clients learn of its result by the network.
"""

from __future__ import annotations

from typing import Any

from vinesim.scene.values import BladeClosing, Breakage, BunchHistory, Detachment, FruitEvent, WireBreak
from vinesim.world import Physics


def events_of(physics: Physics) -> list[dict[str, Any]]:
    """Returns the events of the last step: closings of blades, what gave, wires that broke, detachments, and those of
    fruit."""
    fruit = [_fruit(physics, event) for event in physics.fruit_monitor.events]
    given = map(_breakage, physics.detachment_monitor.breakages)
    wires = map(_wire_break, physics.wire_breaks)
    return [*map(_closing, physics.closings), *given, *wires, *map(_detachment, physics.detachments), *fruit]


def fruit_report(physics: Physics) -> dict[str, Any]:
    """Returns what happened to the bunches that actors touched or that fell, as far as this client simulated it: each
    bunch, and totals."""
    found = [physics.fruit_monitor.history(bunch) for bunch in physics.fruit_monitor.handled()]
    return {
        "bunches": [history_row(one) for one in found],
        "berries": sum(one.berries for one in found),
        "berries_burst": sum(one.berries_burst for one in found),
        "berries_lost": sum(one.berries_lost for one in found),
    }


def history_row(history: BunchHistory) -> dict[str, Any]:
    """Returns what has happened to a bunch, for JSON."""
    return {
        "bunch": history.bunch,
        "berries": history.berries,
        "hand_s": history.hand_time,
        "impulse_ns": history.impulse,
        "peak_force_n": history.peak_force,
        "peak_pressure_pa": history.peak_pressure,
        "drops": history.drops,
        "drop_height_m": history.drop_height,
        "acceleration_mps2": history.acceleration,
        "berries_burst": history.berries_burst,
        "berries_lost": history.berries_lost,
        "damage": history.damage,
    }


def _fruit(physics: Physics, event: FruitEvent) -> dict[str, Any]:
    row = {"event": "fruit", "what": event.what, **history_row(physics.fruit_monitor.history(event.bunch))}
    return row | ({"height_m": event.value} if event.what == "dropped" else {})


def _closing(event: BladeClosing) -> dict[str, Any]:
    return {
        "event": "blade",
        "actor": event.actor,
        "link": event.link,
        "outcome": event.outcome,
        "text": event.sentence,
        "force_n": float(event.force),
        "needed_n": float(event.needed),
        "energy_j": float(event.energy),
        "body": event.body,
        "at_m": float(event.at),
        "diameter_m": float(event.diameter),
        "depth_m": float(event.depth),
        "position": [float(part) for part in event.position],
    }


def _detachment(event: Detachment) -> dict[str, Any]:
    return {
        "event": "detached",
        "cause": event.cause,
        "actor": event.actor,
        "tree": event.tree,
        "body": event.body,
        "bunch": event.bunch,
        "force": [float(part) for part in event.force],
        "moment": [float(part) for part in event.moment],
        "segment": event.segment,
        "at_m": float(event.at),
        "place_m": float(event.place),
        "position": [float(part) for part in event.point],
    }


def _breakage(event: Breakage) -> dict[str, Any]:
    return {
        "event": event.kind,
        "cause": event.cause,
        "actor": event.actor,
        "tree": event.tree,
        "body": event.body,
        "tie": event.tie,
        "force": [float(part) for part in event.force],
        "moment": [float(part) for part in event.moment],
        "place_m": float(event.place),
        "position": [float(part) for part in event.point],
    }


def _wire_break(event: WireBreak) -> dict[str, Any]:
    return {"event": "wire", "piece": event.piece, "tension_n": event.tension, "ties": list(event.ties)}
