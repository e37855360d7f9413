"""Runs: rollouts of a scenario by several models, simulated in small chunks by a single thread.

A run has variants: every model with the goals, and the goal-conditioned models also without, on the same seeds, for
the change of realism. The first four rollouts of each variant come first. A rollout depends on the seed, the scenario
and the rollout's number alone, so chunks are bit for bit the rows of a large simulation, and pressing simulate twice
or changing a goal computes only new rollouts.
"""

import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import RlftsimError
from rlftsim.jobs.progress import log
from rlftsim.policies.registry import with_guidance
from rlftsim.rollout.policy import Sampling, get_device
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.studio import Refusal
from rlftsim.studio.bodies import RunBody
from rlftsim.studio.encoding import encode_batch
from rlftsim.studio.scoring import Scored, score_variant
from rlftsim.studio.session import Session
from rlftsim.studio.variants import Variant, build_variants, free_variant

FIRST_CHUNKS = (4, 4, 8, 16)
LARGEST_CHUNK = 32
KEPT_BYTES = 512 << 20
KEPT_RUNS, KEPT_CONTEXTS = 64, 8


class Cancelled(Exception):
    """The run was replaced or stopped."""


@dataclass(eq=False)
class Simulated:
    """Rollouts of a variant so far; grows by chunks, which runs of different sizes share."""

    chunks: dict[range, Rollouts] = field(default_factory=dict)
    """By numbers of the rollouts."""
    encoded: dict[range, bytes] = field(default_factory=dict)
    scored: dict[tuple[int, str], Scored] = field(default_factory=dict)
    """By number of rollouts and metric."""

    @property
    def num_bytes(self) -> int:
        """Memory of tensors and chunks, about."""
        tensors = (
            p.position.nbytes + p.heading.nbytes + p.decision.nbytes + p.log_prob.nbytes for p in self.chunks.values()
        )
        return sum(tensors) + sum(map(len, self.encoded.values()))


@dataclass(eq=False)
class Run:
    """A press of simulate."""

    name: str
    body: RunBody
    variants: tuple[Variant, ...]
    simulated: tuple[Simulated, ...]
    chunks: list[tuple[int, range]]
    """Variant and rollouts of each chunk, in the order of simulation."""
    events: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    growing: dict[int, bytes] = field(default_factory=dict)
    """Chunks that are being simulated, with the steps so far."""
    is_over: bool = False
    stop: threading.Event = field(default_factory=threading.Event)
    stop_reason: str = "cancelled."

    def tell(self, event: str, **data: Any) -> None:
        """Append an event for the page."""
        self.events.append((event, data))

    def chunk(self, k: int) -> bytes:
        """Poses of chunk `k`, also while the chunk is being simulated.

        Raises:
            Refusal: No such chunk, or no poses yet (404).
        """
        if not 0 <= k < len(self.chunks):
            raise Refusal(f"run {self.name} has no chunk {k}.", status=404)
        variant, ids = self.chunks[k]
        content = self.simulated[variant].encoded.get(ids, self.growing.get(k))
        if content is None:
            raise Refusal(f"chunk {k} of run {self.name} is not simulated yet.", status=404)
        return content

    def rollouts(self, variant: int) -> Rollouts:
        """All rollouts of a variant.

        Raises:
            Refusal: No such variant (404), or the variant is not complete (409).
        """
        if not 0 <= variant < len(self.variants):
            raise Refusal(f"run {self.name} has no variant {variant}.", status=404)
        chunks, expected = self.simulated[variant].chunks, split_rollouts(self.body.num_rollouts)
        if any(ids not in chunks for ids in expected):
            raise Refusal("these rollouts are not complete yet: wait until the run is done.", status=409)
        return join_chunks([chunks[ids] for ids in expected])

    def score(self, variant: int) -> Scored:
        """Score of a variant.

        Raises:
            Refusal: No such variant (404), or the variant is not scored yet (409).
        """
        self.rollouts(variant)
        scored = self.simulated[variant].scored.get((self.body.num_rollouts, self.body.metric))
        if scored is None:
            raise Refusal("these rollouts are not scored yet: wait until the run is done.", status=409)
        return scored


def split_rollouts(num_rollouts: int) -> list[range]:
    """Rollouts that are simulated at once: 4, 4, 8, 16, then 32 each."""
    chunks: list[range] = []
    while (first := chunks[-1].stop if chunks else 0) < num_rollouts:
        size = FIRST_CHUNKS[len(chunks)] if len(chunks) < len(FIRST_CHUNKS) else LARGEST_CHUNK
        chunks.append(range(first, min(first + size, num_rollouts)))
    return chunks


def join_chunks(chunks: list[Rollouts]) -> Rollouts:
    """Rollouts of all chunks of a variant on the CPU; goals and draws are left out."""

    names = ("position", "heading", "decision", "decision_mask", "log_prob")
    values: dict[str, Any] = {name: torch.cat([getattr(chunk, name) for chunk in chunks], 1).cpu() for name in names}
    return Rollouts(**values)


class Worker:
    """A thread that simulates; a new run replaces the waiting run and cancels the running one.

    Args:
        session: Session with the scenarios and models of the runs.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.runs: OrderedDict[str, Run] = OrderedDict()
        self._simulated: OrderedDict[Variant, Simulated] = OrderedDict()
        self._context = lru_cache(KEPT_CONTEXTS)(self._encode)
        self._wake = threading.Condition()
        self._waiting: Run | None = None
        self._running: Run | None = None
        self.is_closed = False
        """True once the studio ends."""
        self._thread = threading.Thread(target=self._work, name="studio worker", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and what it simulates."""
        self.stop()
        self._thread.join(timeout=1.5)

    def stop(self) -> None:
        """Stop the running run at the next decision, and take no further run."""
        with self._wake:
            self.is_closed = True
            for run in (self._running, self._waiting):
                if run is not None:
                    run.stop.set()
            self._wake.notify()

    def submit(self, body: RunBody) -> Run:
        """Queue a run; a run with the same inputs that is complete or under way is returned unchanged.

        Raises:
            Refusal: An unknown scenario or model, or goals that no model takes.
            DataError: An impossible goal, or two for the same agent.
        """
        variants = tuple(build_variants(self.session, body))
        name = hashlib.blake2b(repr((variants, body)).encode(), digest_size=8).hexdigest()
        with self._wake:
            earlier = self.runs.get(name)
            if earlier is not None and not earlier.stop.is_set() and not any(e == "failed" for e, _ in earlier.events):
                self.runs.move_to_end(name)
                return earlier
            run = self._new_run(name, body, variants)
            self.runs[name] = run
            for replaced in (self._running, self._waiting):
                if replaced is not None and not replaced.stop.is_set():
                    replaced.stop_reason = "replaced by a newer run."
                    replaced.stop.set()
            if self._waiting is not None:
                self._end(self._waiting, "failed", message=self._waiting.stop_reason, cancelled=True)
            self._waiting = run
            while len(self.runs) > KEPT_RUNS:
                self.runs.popitem(last=False)
            self._wake.notify()
        return run

    def run(self, name: str) -> Run:
        """Run by name.

        Raises:
            Refusal: The run is not in memory any more (404).
        """
        if name not in self.runs:
            raise Refusal(
                f"no run {name!r}: it belongs to an earlier start, or was dropped.", status=404, hint="Simulate again."
            )
        return self.runs[name]

    def cancel(self, name: str) -> None:
        """Stop a run at the next decision."""
        run = self.run(name)
        with self._wake:
            run.stop.set()
            if run is self._waiting:
                self._waiting = None
                self._end(run, "failed", message=run.stop_reason, cancelled=True)

    def drop(self, name: str) -> None:
        """Cancel and forget a run."""
        self.cancel(name)
        self.runs.pop(name, None)

    def _new_run(self, name: str, body: RunBody, variants: tuple[Variant, ...]) -> Run:
        simulated = []
        for variant in variants:
            simulated.append(self._simulated.setdefault(variant, Simulated()))
            self._simulated.move_to_end(variant)
        # The first chunk of every variant, then the rest; goal-free rollouts only matter for the score, so they end.
        with_goals = {variant.model for variant in variants if variant.goals}
        is_late = [not variant.goals and variant.model in with_goals for variant in variants]
        chunks = [(v, ids) for ids in split_rollouts(body.num_rollouts) for v in range(len(variants))]
        chunks.sort(key=lambda chunk: is_late[chunk[0]])
        return Run(name, body, variants, tuple(simulated), chunks)

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting is not None or self.is_closed)
                if self.is_closed:
                    return
                run, self._waiting = self._waiting, None
                assert run is not None
                self._running = run
            try:
                self._simulate(run)
                self._end(run, "done")
            except Cancelled:
                self._end(run, "failed", message=run.stop_reason, cancelled=True)
            except RlftsimError as error:
                self._end(run, "failed", message=str(error))
            except Exception as error:  # the page must hear of it; the log has the traceback
                log.exception("the run failed")
                self._end(run, "failed", message=f"{type(error).__name__}: {error}; the terminal shows more.")
            with self._wake:
                self._running = None
                self._forget_oldest()

    @staticmethod
    def _end(run: Run, event: str, **data: Any) -> None:
        if event == "failed":
            run.stop.set()
        run.tell(event, **data)
        run.is_over = True

    def _forget_oldest(self) -> None:
        while sum(s.num_bytes for s in self._simulated.values()) > KEPT_BYTES and len(self._simulated) > 1:
            _, dropped = self._simulated.popitem(last=False)
            for name in [name for name, run in self.runs.items() if dropped in run.simulated]:
                del self.runs[name]

    def _simulate(self, run: Run) -> None:
        """Simulate missing chunks in order, and score each variant when complete."""
        scenario = self.session.scenario(run.body.split, run.body.scenario)
        for k, (v, ids) in enumerate(run.chunks):
            simulated = run.simulated[v]
            if ids not in simulated.encoded:
                batch = collate([scenario]).to(get_device(self.session.model(run.variants[v].model).policy))
                rollouts = self._rollouts(run, k, batch)
                poses = torch.cat([rollouts.position, rollouts.heading[..., None]], -1)
                simulated.chunks[ids] = rollouts
                simulated.encoded[ids] = encode_batch(poses, batch)
                run.growing.pop(k, None)
            run.tell("chunk", k=k, variant=v, first=ids.start, count=len(ids), steps=run.variants[v].num_steps)
            if ids.stop == run.body.num_rollouts:
                self._score(run, v)

    def _rollouts(self, run: Run, k: int, batch: ScenarioBatch) -> Rollouts:
        v, ids = run.chunks[k]
        variant, model = run.variants[v], self.session.model(run.variants[v].model)
        policy = with_guidance(model.policy, variant.guidance)
        num_decisions = variant.num_steps // policy.steps_per_decision

        def observe(poses: Float[Tensor, "B N A t 3"]) -> None:
            if run.stop.is_set():
                raise Cancelled
            done = poses.shape[3] // policy.steps_per_decision
            # The first chunk of each variant is shown growing; for later ones the page has something to show.
            if ids.start == 0:
                run.growing[k] = encode_batch(poses, batch)
            run.tell(
                "progress", k=k, variant=v, decision=done, of=num_decisions, first=ids.start,
                count=len(ids), steps=poses.shape[3],
            )  # fmt: skip

        context = self._context(model.name, variant.guidance, variant.split, variant.scenario)
        if run.stop.is_set():
            raise Cancelled
        goals, sampling = variant.goals_in(batch), Sampling(variant.temperature, variant.top_k)
        return simulate(
            policy, batch, num_rollouts=ids, seed=variant.seed, num_steps=variant.num_steps, context=context,
            goals=goals, sampling=sampling, observe=observe,
        )  # fmt: skip

    @torch.no_grad()
    def _encode(self, model: str, guidance: float, split: str, scenario_id: str) -> Any:
        policy = with_guidance(self.session.model(model).policy, guidance)
        return policy.encode(collate([self.session.scenario(split, scenario_id)]).to(get_device(policy)))

    def _score(self, run: Run, v: int) -> None:
        simulated, body = run.simulated[v], run.body
        scenario = self.session.scenario(body.split, body.scenario)
        key = (body.num_rollouts, body.metric)
        if key not in simulated.scored:
            simulated.scored[key] = score_variant(scenario, run.rollouts(v), run.variants[v].goals, body.metric)
        # The change of realism is known once the model's rollouts without goals are there, too; they come last.
        free = free_variant(run.variants, v)
        others = [i for i in range(len(run.variants)) if free == v and i != v and free_variant(run.variants, i) == v]
        for variant in (v, *others):
            base = run.simulated[free].scored.get(key) if variant != free else None
            run.tell("score", variant=variant, **run.simulated[variant].scored[key].to_payload(base))
