"""What is in a model's file, before Keras reads it: whether it is whole, and whether it carries code."""

import json
import zipfile
from pathlib import Path

import h5py

from thesis_repro import InputError

PARTS = ("config.json", "metadata.json", "model.weights.h5")  # of a Keras archive
KERAS = ("keras", "builtins")  # where everything that a model consists of has to come from


def check(path):
    """Look at a model's file, a Keras archive or HDF5, without executing anything and without TensorFlow.

    Raises InputError where it is missing, truncated or neither of them, where it holds a Lambda layer, which is code,
    and where it asks for classes of other packages.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such model; train one or name another file")
    try:
        config = _config(path)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise unreadable(path, error) from None
    _check_classes(path, config)


def unreadable(path, error):
    """The InputError for a model's file that gives an error when it is read."""
    reason = str(error).strip().partition("\n")[0][:200] or type(error).__name__
    return InputError(f"{path}: not a model that Keras can read, or a truncated one ({reason}); copy it or train anew")


def _config(path):
    """What a model consists of according to its file: nested dicts and lists, of JSON."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in PARTS:
                archive.getinfo(name)
            # a loss may be anybody's; it is not read
            return {**json.loads(archive.read(PARTS[0])), "compile_config": None}
    with h5py.File(path, "r") as file:
        return json.loads(file.attrs["model_config"])


def _check_classes(path, config):
    """Raise InputError where a model's description names a Lambda layer or what is not part of Keras."""
    if isinstance(config, list):
        for entry in config:
            _check_classes(path, entry)
    elif isinstance(config, dict):
        name, module = config.get("class_name"), config.get("module")
        if name in ("Lambda", "__lambda__"):
            raise InputError(f"{path}: holds code (a Lambda layer), which is not run; build the network without it and "
                             "save it again")
        if module is not None and str(module).partition(".")[0] not in KERAS:
            raise InputError(f"{path}: asks for {name} of {module}, which is not part of Keras, so it is not loaded; "
                             "build the network of Keras' own layers")
        for entry in config.values():
            _check_classes(path, entry)
