"""The look of a vineyard: what sensors see of it and physics does not need."""

from __future__ import annotations

import dataclasses

from vinesim.scene import palette
from vinesim.scene.palette import DEFAULT, Palette
from vinesim.scene.spec import Clutter, Scene


@dataclasses.dataclass(frozen=True, slots=True)
class FruitLook:
    """What is visible of the state of the fruit; see :class:`vinesim.scene.spec.Fruit`."""

    ripeness: tuple[float, float] | None = None
    """Least and greatest ripeness of a bunch; None: not given."""
    rot: float = 0.0
    shrivelled: float = 0.0
    sunburn: float = 0.0


@dataclasses.dataclass(frozen=True, slots=True)
class Look:
    """Colours, clutter and visible state of the fruit. Old wood and posts, which can be touched, are also in the arrays
    of the model."""

    palette: Palette = DEFAULT
    clutter: Clutter = dataclasses.field(default_factory=Clutter)
    fruit: FruitLook = dataclasses.field(default_factory=FruitLook)
    seed: int = 0
    """Seed of the clutter and of the differences between bunches and berries."""

    @classmethod
    def of(cls, scene: Scene) -> Look:
        """Returns the look that a scene describes."""
        fruit = scene.fruit
        state = FruitLook(fruit.ripeness, fruit.rot, fruit.shrivelled, fruit.sunburn)
        return cls(palette.resolve(scene), scene.clutter, state, scene.seed)
