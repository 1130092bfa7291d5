"""Gather all comparisons that a report makes in an experiment, so that their p-values are adjusted together."""

from gsbench.report import compare, frontier
from gsbench.report.configurations import Group
from gsbench.report.family import Family


def comparisons(group: Group) -> Family:
    """Return all comparisons: pairs of models, models with and without one effect, and the best models in budgets."""
    prices = compare.priced(group)
    contested = frontier.contested(frontier.points(group, group.basis))
    psnr = [*compare.paired(group), *prices, *contested]
    return Family(group, {unit: psnr if unit == "psnr" else prices for unit in compare.PRICES})
