"""Scenarios and rollouts in a notebook: the player of `viewer.page` in a frame below the cell.

`show` is the public function. Importing this module makes a notebook show `Scenario` and `Rollouts` so.
"""

import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.files import write_text
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.open import AnyScenarios, to_scenarios
from rlftsim.scenario.types import Scenario, register_html
from rlftsim.viewer.film import WRITERS, find_writer, to_film
from rlftsim.viewer.page import Animation, animate, animation_html, page_html, read_asset
from rlftsim.viewer.scene import rollout_trajectories

MAX_ROLLOUTS = 4
"""Rollouts that play in one panel: a notebook stores the page in its file, and every rollout adds about 50 kB."""
MAX_SCENARIOS = 3
"""Scenarios of a cell."""
FRAME_HEIGHT = 660
"""Pixels that one scenario takes."""


class Cell:
    """A page that a notebook shows in a frame, and that can be written to a file.

    Args:
        page: HTML of a whole self-contained page.
        height: Height of the frame in pixels; a higher page scrolls.
        animations: Scenes of the page, for films.
    """

    def __init__(self, page: str, height: int = FRAME_HEIGHT, animations: Sequence[Animation] = ()) -> None:
        self.page = page
        self.height = height
        self.animations = animations

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page, which opens in any browser without a network, or a film of the first scenario.

        Args:
            path: File that ends in .html, or for a film in .mp4, .webp or .gif.

        Raises:
            ConfigError: Another ending.
            DataError: The file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() in (".html", ".htm"):
            write_text(path, self.page)
        elif path.suffix.lower() in WRITERS and self.animations:
            to_film(path, self.animations[0])
        else:
            raise ConfigError(f"{path}: a page ends in .html, a film in {', '.join(WRITERS)}: choose one of these.")

    def __repr__(self) -> str:
        return f"Cell({len(self.page) / 1000:.0f} kB page: plays in a notebook, .save('page.html') writes it)"

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self.height}px;border:0"
        # srcdoc keeps styles and scripts of the page apart from those of the notebook.
        return f'<iframe style="{style}" sandbox="allow-scripts" srcdoc="{escape(self.page)}"></iframe>'


def check_rollouts(function: str, scenarios: object, *rollouts: object) -> None:
    """Check the arguments of a function of scenarios and rollouts, which are easily confused.

    Args:
        function: Public name of the function, for the message.
        scenarios: First argument as handed over: scenarios in any form.
        rollouts: Further arguments as handed over.

    Raises:
        ConfigError: A value that is no `Rollouts`, mostly arguments in the wrong order.
        DataError: Rollouts with positions and headings that are no tensors with the axes of rollouts.
    """
    for argument in rollouts:
        if not isinstance(argument, Rollouts) or isinstance(scenarios, Rollouts):
            types = ", ".join(type(value).__name__ for value in (scenarios, *rollouts))
            raise ConfigError(
                f"write rs.{function}(scenario, rollouts), got ({types}): rollouts are those of rs.simulate, arrays of "
                "another simulator go through files, see docs/rollout_formats.md."
            )
        poses = (argument.position, argument.heading)
        are_tensors = all(isinstance(values, Tensor) for values in poses) and argument.heading.dim() == 4
        if not are_tensors or argument.position.shape != (*argument.heading.shape, 2):
            shapes = " and ".join(_describe_shape(values) for values in poses)
            raise DataError(
                f"position and heading of rollouts must be tensors [B, N, A, T, 2] and [B, N, A, T], got {shapes}: "
                "hand over those of rs.simulate, or put such tensors in their place."
            )


def _describe_shape(values: Any) -> str:
    shape = tuple(getattr(values, "shape", ()))
    return str(shape) if isinstance(values, Tensor) else f"{type(values).__name__} {shape}"


def show(scenario: AnyScenarios, *rollouts: Rollouts, titles: str | Sequence[str] = ()) -> Cell:
    """Player of the logged scenario beside its rollouts, for a notebook cell.

    Boxes that overlap are marked; the first rollouts of each argument can be played.

    Args:
        scenario: A scenario; of several, a batch or a data set the first 3 are shown. A name of a data set stands for
            the split validation.
        rollouts: Rollouts of the same scenarios, a panel each, such as those of a base model and of a tuned model.
        titles: Titles of the panels with rollouts, in the same order; left out, "rollouts" or "rollouts 1",
            "rollouts 2", ...

    Returns:
        A value that a notebook displays; `save("page.html")` writes the page, `save("film.mp4")` a film.

    Raises:
        ConfigError: Rollouts of other scenarios, more titles than rollouts, or no scenario.
        DataError: No data set of this name, or without this split, or a scenario with other agents than the simulated
            scenario.
    """
    check_rollouts("show", scenario, *rollouts)
    titles = (titles,) if isinstance(titles, str) else titles
    if len(titles) > len(rollouts):
        raise ConfigError(f"{len(titles)} titles for {len(rollouts)} rollouts: give one each, or none.")
    numbered = [f"rollouts {i + 1}" for i in range(len(rollouts))] if len(rollouts) > 1 else ["rollouts"]
    names = [*titles, *numbered[len(titles) :]]
    scenarios = to_scenarios(scenario)
    # One figure a scenario: the log, then one panel for each argument of rollouts.
    animations = []
    for row in range(min(len(scenarios), MAX_SCENARIOS)):
        log = scenarios[row]
        for simulated in rollouts:
            if simulated.valid is not None and simulated.provenance is not None:  # with the agents that enter
                log = simulated.provenance.scenarios[simulated.find_row(log.scenario_id)]
        motions = []
        for name, simulated in zip(names, rollouts):
            if simulated.provenance is None and len(simulated.position) != len(scenarios):
                raise ConfigError(
                    f"rollouts of {len(simulated.position)} scenarios do not belong to {len(scenarios)}: hand over the "
                    "scenarios they are of."
                )
            # By id where the rollouts know their scenarios, else by position.
            batch_row = row if simulated.provenance is None else simulated.find_row(log.scenario_id)
            motions.append((name, rollout_trajectories(log, simulated, row=batch_row, max_rollouts=MAX_ROLLOUTS)))
        animations.append(animate(log, motions))
    figures = "\n".join(map(animation_html, animations))
    # panels are low enough for the frame, and the controls stay inside, whatever the width of the cell
    page = page_html(f"Scenario {scenarios[0].scenario_id}", figures, extra_css=read_asset("frame.css"))
    return Cell(page, FRAME_HEIGHT * len(animations), animations)


def film(
    scenario: AnyScenarios,
    rollouts: Rollouts | Sequence[Rollouts],
    path: str | os.PathLike[str],
    *,
    titles: str | Sequence[str] = (),
) -> Path:
    """Write a film of a scenario: the log beside the first rollout of each model, in real time. Returns the file.

    Args:
        scenario: A scenario; of several the first is filmed.
        rollouts: Rollouts of the same scenarios; several in a list have a panel each.
        path: File that ends in .mp4, .webp or .gif.
        titles: Titles of the panels with rollouts, as for `show`.

    Raises:
        ConfigError: Another ending, or what `show` refuses.
        DataError: What `show` refuses, or a file that cannot be written.
    """
    path = Path(path)
    find_writer(path)
    arguments = [rollouts] if isinstance(rollouts, Rollouts) else rollouts
    show(scenario, *arguments, titles=titles).save(path)
    return path


def _show_rollouts(rollouts: Rollouts) -> str | None:
    """Frame that plays rollouts beside the log; None for rollouts without scenarios."""
    return None if rollouts.provenance is None else show(rollouts.provenance.scenarios, rollouts)._repr_html_()


register_html(Scenario, lambda scenario: show(scenario)._repr_html_())
register_html(Rollouts, _show_rollouts)
