"""Identify a run by its config: its label, its folder, and the config that its record keeps."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsbench.config import Config
from gsbench.measure import record as records
from gsbench.run.checks import check_config


@dataclass(frozen=True)
class Run:
    """One model on one scene with one seed."""

    config: Config
    plain: dict[str, Any]  # the config as recorded
    folder: Path  # where the record, the checkpoint and the images go
    label: str  # the model's name, with _agr or _noagr where it is not as published

    @property
    def name(self) -> str:
        """The scene, the label and the seed, as messages show them."""
        return f"{self.config.scene.name} {self.label} seed{self.config.seed}"


def identify(composed: DictConfig) -> Run:
    """Resolve and check a config of one scene.

    Raises:
        InputError: a value that no run can have. Hydra has already refused unknown keys and wrong types.
    """
    config: Config = OmegaConf.to_object(composed)  # type: ignore[assignment]
    check_config(config)
    as_published = config.agr == config.model.published_with_agr
    label = config.model.name + ("" if as_published else "_agr" if config.agr else "_noagr")
    folder = records.run_path(Path(config.results), config.experiment, config.scene.name, label, config.seed)
    plain: dict[str, Any] = OmegaConf.to_container(composed, resolve=True)  # type: ignore[assignment]
    for key in ("results", "resume"):  # where results lie and whether they are kept changes no number
        del plain[key]
    return Run(config, plain, folder, label)
