"""Say which parts of a model are switched on at some step: the schedule of a training sets it, the model follows."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Phase:
    """The parts of a model that are switched on at some step of the training."""

    sh_degree: int
    refine: bool  # AGR moves the parameters and learns
    tune_modulation: bool  # lambda_t and lambda_d learn
