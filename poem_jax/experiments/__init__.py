"""The experiments that ship with the package, and the way to open them or your own.

One Python file each: its docstring says what is trained, on which hardware, in what time, and which number to
expect; its variable `config` is the whole `TrainConfig`. One that is several, which differ in a word, has the
others in `configs`, opened as `v1_paper:mvp-ho3d`.
"""

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType

from poem_jax.training.config import TrainConfig


def open_experiment(name: str | Path) -> TrainConfig:
    """Return the config of an experiment.

    Args:
        name: An experiment of the package, such as `tiny_synthetic`, or the path of a Python file that
            defines `config = TrainConfig(...)`; of a file with several, `NAME:WHICH`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The package has no experiment of that name, or the file defines no `config`, or none of
            that name among its `configs`.
    """
    file, _, which = (str(name), "", "") if Path(name).is_file() else str(name).partition(":")
    module = _from_file(Path(file)) if isinstance(name, Path) or _is_path(file) else _from_package(file)
    configs = getattr(module, "configs", {})
    if which and which not in configs:
        has = f"has {', '.join(configs)}" if configs else "is one experiment, with nothing behind a colon"
        raise ValueError(f"no experiment is called {name!s}; {file} {has}")
    config = configs[which] if which else getattr(module, "config", None)
    if not isinstance(config, TrainConfig):
        raise ValueError(
            f"{module.__file__} must define `config = TrainConfig(...)`; it defines {_public_names(module)}"
        )
    return config


def experiment_names() -> list[str]:
    """Return the names of the experiments that ship with the package."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return [file.stem for file in files if file.stem not in ("__init__", "synthetic_benchmark")]


def _is_path(name: str) -> bool:
    return name.endswith(".py") or len(Path(name).parts) != 1


def _from_package(name: str) -> ModuleType:
    if name not in experiment_names():
        raise ValueError(
            f"no experiment is called {name!r}; the package has {', '.join(experiment_names())}. "
            "Another one is opened by the path of its file, ending in .py"
        )
    return importlib.import_module(f"poem_jax.experiments.{name}")


def _from_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise FileNotFoundError(f"experiment file not found: {path}")
    spec = importlib.util.spec_from_file_location(f"experiment_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file: an experiment's file ends in .py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _public_names(module: ModuleType) -> list[str]:
    return sorted(name for name in vars(module) if not name.startswith("_"))
