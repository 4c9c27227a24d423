"""Policies: networks that choose actions, in files that need neither PyTorch nor a GPU."""

from __future__ import annotations

import dataclasses
import io
import pathlib
import zipfile
from collections.abc import Callable

import numpy as np

from vinesim.core.data_files import DataFileNotFound, find_data_file
from vinesim.core.errors import writing
from vinesim.core.toml_loader import DataError
from vinesim.sensors.export.files import write_files

FORMAT = "vinesim policy 1"
"""Text in a policy's file by which it is recognised."""


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": _elu,
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
}
"""Functions between two layers, by name."""


class PolicyError(DataError):
    """Raised for a file that is no policy of vinesim. The message is one line."""


@dataclasses.dataclass(frozen=True, repr=False)
class Policy:
    """A network of fully connected layers. ``policy(observation)`` returns the action, in an array of NumPy.

    Raises :class:`ValueError` for observations of another shape. When it is made, raises the same for arrays whose
    shapes do not fit, numbers that are not finite, deviations that are not above 0, and an unknown activation.
    """

    task: str
    """Name of the task, as in :data:`vinesim.learn.TASKS`."""
    mean: np.ndarray
    """[k] Mean of the observations in training."""
    deviation: np.ndarray
    """[k] Scale by which observations are divided when their mean is subtracted."""
    weights: tuple[np.ndarray, ...]
    """[layer][output, input] Weights."""
    biases: tuple[np.ndarray, ...]
    """[layer][output]"""
    activation: str = "elu"
    """Name of the function between two layers, one of :data:`ACTIVATIONS`."""

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"activation {self.activation!r}: give one of {', '.join(ACTIVATIONS)}")
        if not self.weights or len(self.weights) != len(self.biases):
            raise ValueError(f"{len(self.weights)} arrays of weights, {len(self.biases)} of biases: give one a layer")
        if self.mean.ndim != 1 or self.deviation.shape != self.mean.shape:
            raise ValueError(f"mean {self.mean.shape}, deviation {self.deviation.shape}: give one number a component")
        width = len(self.mean)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
                raise ValueError(f"layer {i}: weights {weight.shape} and biases {bias.shape} after {width} numbers")
            width = len(weight)
        for array in (self.mean, self.deviation, *self.weights, *self.biases):
            if array.dtype.kind != "f" or not np.isfinite(array).all():
                raise ValueError("it has numbers that are not finite real numbers")
        if (self.deviation <= 0.0).any():
            raise ValueError("a deviation is not above 0")

    @property
    def inputs(self) -> int:
        """Number of an observation's components."""
        return len(self.mean)

    @property
    def outputs(self) -> int:
        """Number of an action's components."""
        return len(self.biases[-1])

    def __repr__(self) -> str:
        widths = " -> ".join(map(str, (self.inputs, *map(len, self.biases))))
        return f"Policy({self.task!r}, {widths}, {self.activation!r})"

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns the actions [..., outputs], from -1 to 1, for observations [..., inputs]."""
        if isinstance(observation, dict):
            raise ValueError("an observation with pictures: give the policy its numbers, observation['state']")
        given = np.asarray(observation, np.float32)
        if given.shape[-1:] != self.mean.shape:
            raise ValueError(f"observations {given.shape}: the policy for {self.task} takes [..., {self.inputs}]")
        x = (given - self.mean) / self.deviation
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = ACTIVATIONS[self.activation](x @ weight.T + bias)
        return np.clip(x @ self.weights[-1].T + self.biases[-1], -1.0, 1.0).astype(np.float32)

    def check_numbers(self, inputs: int, outputs: int) -> None:
        """Raise :class:`PolicyError` unless observations have ``inputs`` components, and actions ``outputs``."""
        if (self.inputs, self.outputs) != (inputs, outputs):
            raise PolicyError(
                f"the policy maps {self.inputs} numbers to {self.outputs}, task {self.task} has {inputs} and "
                f"{outputs}; train it again"
            )

    def save(self, path: str | pathlib.Path) -> None:
        """Write the policy into an .npz file. Raises :class:`~vinesim.core.errors.WriteError`."""
        layers = {f"weight_{i}": weight for i, weight in enumerate(self.weights)}
        layers |= {f"bias_{i}": bias for i, bias in enumerate(self.biases)}
        names = {"format": FORMAT, "task": self.task, "activation": self.activation}
        data = io.BytesIO()
        np.savez(data, mean=self.mean, deviation=self.deviation, **layers, **names)  # pyright: ignore[reportArgumentType]
        with writing(path):
            write_files({pathlib.Path(path): [data.getvalue()]})


def load_policy(name: str | pathlib.Path) -> Policy:
    """Returns the policy in the file ``name``, or the one that ships with vinesim under that name (``data/policies``).
    Raises :class:`PolicyError`."""
    if pathlib.Path(name).is_dir():
        raise PolicyError(f"{name} is a folder; give the policy.npz of a training")
    try:
        path = find_data_file("policies", str(name), ".npz")
    except DataFileNotFound as error:
        raise PolicyError(str(error)) from None
    try:
        with zipfile.ZipFile(path):  # NumPy would also take a single array
            pass
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        raise PolicyError(
            f"{path} cannot be read: {error.strerror or error}; give the policy.npz of a training"
        ) from None
    except (ValueError, EOFError, zipfile.BadZipFile):
        raise PolicyError(f"{path} is no policy; give the policy.npz of a training") from None
    if str(arrays.get("format")) != FORMAT:
        raise PolicyError(f"{path} is no policy of this version; its field format is not {FORMAT!r}")
    count = sum(name.startswith("weight_") for name in arrays)
    try:
        return Policy(
            str(arrays["task"]),
            arrays["mean"],
            arrays["deviation"],
            _layers(arrays, "weight", count),
            _layers(arrays, "bias", count),
            str(arrays["activation"]),
        )
    except KeyError as error:
        raise PolicyError(f"{path}: there is no field {error.args[0]}; the file is damaged") from None
    except ValueError as error:
        raise PolicyError(f"{path}: {error}; the file is damaged") from None


def _layers(arrays: dict[str, np.ndarray], name: str, count: int) -> tuple[np.ndarray, ...]:
    return tuple(arrays[f"{name}_{i}"] for i in range(count))
