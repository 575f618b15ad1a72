"""Files of Keras 2: what Keras 3 reads after a change of the network's description, and what not.

The description is JSON, in an attribute of the HDF5 file. Its layers state settings that Keras 3
dropped, and its nodes are counted otherwise. What means something else today is refused by name.
"""

import inspect
import json
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import keras

from thesis_repro.errors import InputError

# ends of names of settings that say nothing for a prediction
NEEDLESS = ("_initializer", "_regularizer", "_constraint", "rng_type", "trainable")
REBUILD = "build the network in Keras 3, load the weights of this file, and save it"


@contextmanager
def readable(path: str | Path) -> Iterator[Path]:
    """Yield a file that Keras 3 reads as Keras 2 meant it: the given one, or a changed copy.

    The copy lies in the system's temporary folder until the block ends. Raises InputError for what
    Keras 3 lacks or computes otherwise.
    """
    path = Path(path)
    _refuse_zip_of_keras_2(path)
    if not h5py.is_hdf5(path):
        yield path
        return
    with h5py.File(path) as file:
        text = file.attrs.get("model_config")
    if text is None:
        raise InputError(
            f"{path}: holds weights alone, no network; save both, model.save('model.h5')"
        )
    description = json.loads(text)
    changed = _as_keras_3(path, description)
    if changed == description and path.suffix in (".h5", ".hdf5"):
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = shutil.copyfile(path, Path(folder, "model.h5"))
        with h5py.File(copy, "r+") as file:
            file.attrs["model_config"] = json.dumps(changed)
        yield copy


def _refuse_zip_of_keras_2(path: Path) -> None:
    """Raise InputError for a `.keras` file of Keras 2, which Keras 3 does not read."""
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as file:
        if "metadata.json" not in file.namelist():
            return
        version = json.loads(file.read("metadata.json")).get("keras_version", "")
    if version.startswith("2."):
        raise InputError(
            f"{path}: written by Keras {version}, whose .keras files Keras 3 does not read; save it as HDF5 "
            "with that Keras, model.save('model.h5')"
        )


def _as_keras_3(path: Path, description: dict[str, Any]) -> dict[str, Any]:
    """Return a changed copy of a description, or of that of a layer, and of all layers in it."""
    changed = deepcopy(description)
    if isinstance(changed["config"], list):  # a Sequential before Keras 2.2.3
        changed["config"] = {"name": "sequential", "layers": changed["config"]}
    config = changed["config"]
    _drop_needless(changed["class_name"], config)
    if "module" not in changed:  # Keras 3 states it
        _refuse(path, changed["class_name"], config)
        if isinstance(config.get("dtype"), dict):
            config["dtype"] = config["dtype"]["config"]["name"]
        if changed["class_name"] == "Sequential":
            _state_input(config)
    if "layers" in config:
        config["layers"] = [_as_keras_3(path, layer) for layer in config["layers"]]
        if not any("module" in layer for layer in config["layers"]):
            _count_nodes(config)
    if isinstance(config.get("layer"), dict):  # of a wrapper
        config["layer"] = _as_keras_3(path, config["layer"])
    return changed


def _drop_needless(name: str, config: dict[str, Any]) -> None:
    """Delete settings of a layer that Keras 3 lacks, if they say nothing for a prediction."""
    layer = getattr(keras.layers, name, None)
    if not inspect.isclass(layer):
        return
    known: set[str] = set()
    for kind in layer.__mro__:
        settings = inspect.signature(kind.__init__).parameters  # type: ignore[misc]
        known |= set(settings)
        if "kwargs" not in settings:  # what it does not know, it does not pass on
            break
    for key in set(config) - known:
        if config[key] is None or key.endswith(NEEDLESS) or (key, config[key]) == ("groups", 1):
            del config[key]


def _refuse(path: Path, name: str, config: dict[str, Any]) -> None:
    """Raise InputError for a layer of Keras 2 that Keras 3 lacks or computes otherwise."""
    written = f"{path}: written by Keras 2 with"
    if name == "Lambda":
        raise InputError(f"{path}: holds code, in a Lambda layer; build it from Keras' own layers")
    if "layers" not in config and not hasattr(keras.layers, name):
        function = f" ({config['function']})" if isinstance(config.get("function"), str) else ""
        raise InputError(f"{written} layer {name}{function}, which Keras 3 lacks; {REBUILD}")
    if "hard_sigmoid" in (config.get("activation"), config.get("recurrent_activation")):
        raise InputError(
            f"{written} the activation hard_sigmoid, which Keras 3 computes otherwise; {REBUILD}"
        )
    if isinstance(config.get("axis"), list) and len(config["axis"]) > 1:
        raise InputError(f"{written} layer {name} over several axes, which are lost; {REBUILD}")


def _state_input(config: dict[str, Any]) -> None:
    """Begin a Sequential with an input layer; before Keras 2.3, its first layer stated the size."""
    first = config["layers"][0]
    shape = first["config"].get("batch_input_shape") if "layers" not in first["config"] else None
    if shape and first["class_name"] != "InputLayer":
        entry = {"batch_input_shape": shape, "dtype": "float32", "name": "input_of_sequential"}
        del first["config"]["batch_input_shape"]
        config["layers"].insert(0, {"class_name": "InputLayer", "config": entry})


def _count_nodes(config: dict[str, Any]) -> None:
    """Count the calls of a network within the network from 0; Keras 2 counted from 1.

    A lone input or output is no list today.
    """
    for key in ("input_layers", "output_layers"):
        if len(config.get(key, ())) == 1:
            config[key] = config[key][0]
    calls = {
        layer["name"]: len(layer["inbound_nodes"])
        for layer in config["layers"]
        if "layers" in layer["config"] and layer.get("inbound_nodes")
    }
    uses = [use for layer in config["layers"] for use in _uses(layer.get("inbound_nodes"))]
    last = {name: max((use[1] for use in uses if use[0] == name), default=0) for name in calls}
    for use in uses:
        if use[0] in calls and last[use[0]] == calls[use[0]]:
            use[1] -= 1
    sequential = {x["name"] for x in config["layers"] if x["class_name"] == "Sequential"} & {*calls}
    for use in _uses(config.get("output_layers")):
        if use[0] in sequential:  # Keras 3 subtracts 1 itself for other networks
            use[1] -= 1


def _uses(nodes: Any) -> Iterator[list]:
    """Yield what a part of a description refers to: lists of a layer, the call, the output."""
    if isinstance(nodes, dict):
        nodes = list(nodes.values())
    if isinstance(nodes, list):
        if len(nodes) >= 3 and isinstance(nodes[0], str) and isinstance(nodes[1], int):
            yield nodes
        else:
            for each in nodes:
                yield from _uses(each)
