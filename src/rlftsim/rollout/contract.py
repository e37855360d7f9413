"""Rules of a contract, each tried on an object, and the report of those that hold.

A contract is a class with a public method for each rule, which returns the measurement as a text, or raises
`RuleBroken` or `RuleNotApplicable`.
"""

import math
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from rlftsim.errors import locate_error

Outcome = Literal["passed", "failed", "not applicable"]


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one rule of the contract."""

    rule: str
    """Statement that has to hold."""
    outcome: Outcome
    detail: str
    """The measurement, or the reason for which the rule does not apply."""

    def __str__(self) -> str:
        return f"{self.outcome:>14}  {self.rule}: {self.detail}"


@dataclass(frozen=True)
class CheckReport:
    """Outcomes of all rules of the contract."""

    name: str
    """Policy or reward that was tried."""
    results: tuple[CheckResult, ...]

    @property
    def failures(self) -> tuple[CheckResult, ...]:
        """Results of the violated rules."""
        return tuple(r for r in self.results if r.outcome == "failed")

    @property
    def is_passed(self) -> bool:
        """True if no rule is violated."""
        return not self.failures

    def __str__(self) -> str:
        count = sum(r.outcome == "passed" for r in self.results)
        summary = f"{self.name}: {count} rules passed, {len(self.failures)} failed."
        return "\n".join([summary, *(str(r) for r in self.results)])


class RuleNotApplicable(Exception):
    """The rule does not apply here; the message has the reason."""


class RuleBroken(Exception):
    """The rule is violated; the message has the measurement."""


def check_rules(rules: object, name: str) -> CheckReport:
    """Try every rule of a contract.

    Args:
        rules: Object of a contract, with the policy or reward to try.
        name: Name of the policy or reward, for the report.

    Returns:
        A result per rule. A rule with an error in the check counts as failed, with the error as detail.
    """
    results = []
    for rule, check in vars(type(rules)).items():
        if rule.startswith("_"):
            continue
        outcome: Outcome = "passed"
        try:
            detail = check(rules)
        except RuleNotApplicable as error:
            outcome, detail = "not applicable", str(error)
        except RuleBroken as error:
            outcome, detail = "failed", str(error)
        except Exception as error:  # whatever is raised is an outcome of the test
            outcome, detail = "failed", f"raised {type(error).__name__}: {error} ({locate_error(error)})"
        results.append(CheckResult(rule.replace("_", " "), outcome, detail))
    return CheckReport(name, tuple(results))


def check_limit(measured: float, allowed: float, title: str = "largest gap") -> str:
    """Text of a measurement, or `RuleBroken` with the text."""
    text = f"{title} {measured:.2g}, allowed {allowed:g}"
    if not measured <= allowed:
        raise RuleBroken(text)
    return text


def compute_gap(a: Tensor, b: Tensor) -> float:
    """Largest absolute difference; infinite where shapes differ or a value is not finite."""
    if a.shape != b.shape or not (a.isfinite().all() and b.isfinite().all()):
        return math.inf
    return float((a.detach().double() - b.detach().double()).abs().max()) if a.numel() else 0.0


def check_gap(a: Tensor, b: Tensor, allowed: float, title: str = "largest gap") -> str:
    """Text of the largest absolute difference, or `RuleBroken` with the text."""
    return check_limit(compute_gap(a, b), allowed, title)


def check_worst(gaps: dict[str, float], allowed: float, title: str) -> str:
    """Text of the largest of named gaps, or `RuleBroken` with the text."""
    worst = max(gaps, key=lambda name: gaps[name])
    return check_limit(gaps[worst], allowed, f"{title} ({worst})")
