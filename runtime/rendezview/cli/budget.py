"""The errors of a run's poses by cause, on the terminal."""

from __future__ import annotations

from rendezview.cli.progress import say, say_table
from rendezview.sensors.beacons.budget import Budget, budget_rows, unknown_causes


class BudgetReport:
    """Says at the end of a run what its covariances leave out and, if wanted, their causes."""

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted
        self._budgets: list[Budget] = []

    def take(self, budget: Budget | None) -> None:
        """The budget of a reading; None: it has no pose."""
        if budget is not None and (self._wanted or not self._budgets):
            self._budgets.append(budget)

    def tell(self) -> None:
        """Say what is not known, and print the median σ of each cause."""
        if not self._budgets:
            return
        unknown = unknown_causes(self._budgets[0])
        if unknown is not None:
            say(unknown)
        if self._wanted:
            say_table(("cause", "σ of attitude, °", "σ of place, mm"), budget_rows(self._budgets))
