"""When an expression held: equal to a plain-Python learner's, evaluated by Python after every step."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import runner
from runner.environments.loading import load_mdp
from runner.environments.naming import action_names, actions_in_words
from tests.runner.learning.twin import Twin
from tests.runner.recording.making import TAXIS, experiment, make_run

SHORT: dict[str, Any] = {"evaluation": None, "log": None, "episodes": 12, "recording": {"chunk_steps": 256}}
BY_STEP = {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 900, "by": "step"}
BY_EPISODE = {"schedule": "exponential", "start": 1.0, "factor": 0.9, "floor": 0.05}
RUNS: dict[str, dict[str, Any]] = {
    "cooperative": TAXIS | {"mode": "cooperative", "epsilon": BY_STEP, "step_size": 1.0, "discount": 0.9},
    "competitive": TAXIS | {"epsilon": BY_EPISODE},
    "sarsa": TAXIS | {"algorithm": "sarsa"},
    "expected sarsa": TAXIS | {"algorithm": "expected_sarsa", "mode": "cooperative"},
    "double": TAXIS | {"algorithm": "double_q_learning", "initial_q": "random"},
    "hysteretic": TAXIS
    | {"algorithm": "hysteretic_q_learning", "quirks": {"bootstrap_after_termination": True}},
    "sarsa lambda": TAXIS | {"algorithm": "sarsa_lambda"},
    "n-step": TAXIS | {"algorithm": "n_step_q_learning", "mode": "cooperative"},
    "wolf": TAXIS | {"algorithm": "wolf_phc", "exploration": "independent"},
}


@pytest.fixture(scope="module", params=RUNS)
def job(request, tmp_path_factory):
    """A finished run, and what the plain learner knew after each of its steps."""
    run = make_run(tmp_path_factory.mktemp("when"), RUNS[request.param] | SHORT)
    return run, History(run)


class Known:
    """What an expression may name, after a number of steps, as Python objects."""

    def __init__(
        self, values: dict[Any, Any], learners: tuple[str, ...] = (), own: dict[Any, Any] | None = None
    ) -> None:
        self._values = values
        for i, name in enumerate(learners):
            setattr(self, name, Known({key[1:]: value for key, value in (own or {}).items() if key[0] == i}))

    def __getitem__(self, key: Any) -> Any:
        return self._values[key if isinstance(key, tuple) else (key,)]


class History:
    """The names of an expression after each step of a run, and before the first, by the plain learner."""

    def __init__(self, run: runner.Run) -> None:
        config = experiment(run.facts["config"])
        self.mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)
        self.twin = Twin(config, self.mdp, 0)
        self.learners = ("agency",) if self.twin.learners == 1 else self.mdp.agents
        rehearsal = Twin(config, self.mdp, 0)
        rehearsal.train(config.episodes, 10**9)
        often = Counter(step.state for step in rehearsal.training.steps).most_common()
        self.states = [often[k][0] for k in (0, 3, 20, -1)]
        """States of the expressions, some visited often, one hardly."""
        self.visits: Counter[tuple[int, ...]] = Counter()
        self.own_visits: Counter[tuple[int, ...]] = Counter()
        self.names = [self._names()]
        self.steps = []
        while len(self.twin.training.episodes) < config.episodes:
            self.twin.train(config.episodes, len(self.steps) + 1)
            self.steps.append(self.twin.training.steps[-1])
            self.names.append(self._names())

    def _names(self) -> dict[str, Any]:
        q, greedy, visits = {}, {}, {}
        several = self.twin.learners > 1
        last = self.twin.training.steps[-1] if self.twin.training.steps else None
        if last is not None:
            for i, action in enumerate(self.twin._own(last.action)):
                self.own_visits.update([(i, last.state), (i, last.state, action)])
            self.visits.update([(last.state,), (last.state, last.action)])
        for i, width in enumerate(self.twin.widths):
            for state in self.states:
                row = self.twin.tables[i][state]
                q[i, state], greedy[i, state] = list(row), row.index(max(row))
                visits[i, state] = self.own_visits[i, state]
                for action in range(width):
                    q[i, state, action] = row[action]
                    visits[i, state, action] = self.own_visits[i, state, action]
        names: dict[str, Any] = {
            "max": _most(max),
            "min": _most(min),
            "greedy_success": Known({(state,): self._delivers(state) for state in self.states}),
        }
        joint = {
            (state,): self.twin._joint([self.twin._greedy(i, state) for i in range(self.twin.learners)])
            for state in self.states
        }
        joint_visits = {key: self.visits[key] for key in self._joint_keys()}
        if several:
            names["q"], names["greedy"] = Known({}, self.learners, q), Known(joint, self.learners, greedy)
            names["visits"] = Known(joint_visits, self.learners, visits)
        else:
            names["q"] = Known({key[1:]: value for key, value in q.items()})
            names["greedy"], names["visits"] = Known(joint), Known(joint_visits)
        if last is not None:
            names |= {"step": last.step, "episode": last.episode}
            names["epsilon"] = self.twin.epsilon(last.episode, last.step)
            rewards = {(i,): reward for i, reward in enumerate(last.rewards)}
            names["reward"] = last.rewards[0] if not several else _Rewards(self.learners, rewards)
        return names

    def _joint_keys(self) -> list[tuple[int, ...]]:
        actions = range(self.mdp.joint_actions)
        return [(state,) for state in self.states] + list(itertools.product(self.states, actions))

    def _delivers(self, state: int) -> bool:
        seen = set()  # who comes back walks in a circle
        while state not in seen and len(seen) < self.mdp.step_limit:
            seen.add(state)
            action = self.twin._joint([self.twin._greedy(i, state) for i in range(self.twin.learners)])
            if self.mdp.events[state, action, 0] & self.mdp.success_mask:
                return True
            if self.mdp.terminated[state, action, 0]:
                return False
            state = int(self.mdp.next_state[state, action, 0])
        return False

    def intervals(self, expression: str, first: int, last: int) -> list[tuple[int, int | None]]:
        """Return the intervals of an expression, by evaluating it after every step."""
        code = compile(expression, "expression", "eval")
        found: list[tuple[int, int | None]] = []
        held = False
        for step in range(first, last + 1):
            holds = bool(eval(code, {}, self.names[step + 1]))
            if holds and not held:
                found.append((step, None))
            elif held and not holds:
                found[-1] = (found[-1][0], step)
            held = holds
        return found


class _Rewards:
    def __init__(self, learners: tuple[str, ...], rewards: dict[Any, float]) -> None:
        for i, name in enumerate(learners):
            setattr(self, name, rewards[i,])


def _most(function: Any) -> Any:
    return lambda *values: function(values[0]) if len(values) == 1 else function(values)


@st.composite
def expressions(draw: Any, history: History) -> str:
    """Make an expression over what a run has."""
    several = len(history.learners) > 1

    def number(depth: int) -> str:
        state = draw(st.sampled_from(history.states))
        own = draw(st.sampled_from(history.learners)) if several else ""
        of = f".{own}" if several else ""
        width = history.twin.widths[0]
        action = draw(st.integers(0, width - 1))
        kinds = [
            "q",
            "max",
            "min",
            "visits",
            "own visits",
            "step",
            "episode",
            "epsilon",
            "reward",
            "two",
        ]
        kind = draw(st.sampled_from(kinds if depth else kinds[:-1]))
        other = draw(st.sampled_from(["+", "-", "*"])) if kind == "two" else ""
        made = {
            "q": f"q{of}[{state}, {action}]",
            "max": f"max(q{of}[{state}])",
            "min": f"min(q{of}[{state}])",
            "visits": f"visits[{state}]",
            "own visits": f"visits{of}[{state}, {action}]",
            "reward": f"reward{of}",
        }
        if kind == "two":
            return f"({number(0)} {other} {number(0)})"
        return made.get(kind, kind)

    def condition(depth: int) -> str:
        kind = draw(st.integers(0, 6 if depth else 2))
        if kind <= 1:
            constant = draw(st.sampled_from(["0", "-1", "-2.5", "3", "0.25", "10", "400"]))
            sign = draw(st.sampled_from(["<", "<=", ">", ">=", "==", "!="]))
            return f"{number(1)} {sign} {draw(st.sampled_from([constant, number(1)]))}"
        if kind == 2:
            return f"greedy_success[{draw(st.sampled_from(history.states))}]"
        if kind == 6:
            own = draw(st.sampled_from(["", *(f".{each}" for each in history.learners if several)]))
            first, second = (f"greedy{own}[{draw(st.sampled_from(history.states))}]" for _ in range(2))
            action = str(draw(st.integers(0, history.twin.widths[0] - 1)))
            sign = draw(st.sampled_from(["==", "!="]))
            return f"{first} {sign} {draw(st.sampled_from([action, second]))}"
        if kind == 3:
            return f"not ({condition(depth - 1)})"
        return f"({condition(depth - 1)} {draw(st.sampled_from(['and', 'or']))} {condition(depth - 1)})"

    return condition(2)


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data())
def test_the_intervals_are_those_of_evaluating_it_after_every_step(job, data):
    run, history = job
    expression = data.draw(expressions(history))
    end = len(history.steps) - 1
    first = data.draw(st.just(0) | st.integers(0, end))
    last = data.draw(st.just(end) | st.integers(first, end))
    expected = history.intervals(expression, first, last)
    found = runner.when(run, expression, every=True, first=first, last=last)
    assert found.searched == (first, last)
    assert [(each.start.step, each.end and each.end.step) for each in found.intervals] == expected
    assert found.count == len(expected)
    assert found.steps == sum((last + 1 if stop is None else stop) - start for start, stop in expected)
    once = runner.when(run, expression, first=first, last=last)
    assert (once.first and once.first.step) == (expected[0][0] if expected else None)
    for each in found.intervals[:20]:
        check_values(history, each.start)
        if each.end is not None:
            check_values(history, each.end)


def check_values(history: History, moment: Any) -> None:
    """Compare the values of a moment with those of evaluating its parts before and after the step."""
    step = history.steps[moment.step]
    assert (moment.episode, moment.t) == (step.episode, step.t)
    names = [str(name) for name in actions_in_words(history.mdp)]
    for value in moment.values:
        for found, at in ((value.before, moment.step), (value.after, moment.step + 1)):
            known = history.names[at]
            if found is None:
                assert at == 0
                assert any(
                    re.search("step|episode|reward|epsilon", each.expression) for each in moment.values
                )
                continue
            expected = eval(value.expression, {}, known)
            if re.fullmatch(r"greedy\[\d+\]", value.expression):
                expected = names[expected]
            elif re.fullmatch(r"greedy\.\w+\[\d+\]", value.expression):
                expected = action_names(history.mdp)[0][expected]
            assert found == expected


def test_a_greedy_path_is_found_when_it_begins_to_deliver_and_when_it_is_lost(tmp_path):
    run = make_run(tmp_path, TAXIS | {"mode": "cooperative"} | SHORT, episodes=120, discount=0.95)
    history = History(run)
    end = len(history.steps) - 1
    total = 0
    for state in history.states:
        found = runner.when(run, f"greedy_success[{state}]", every=True)
        expected = history.intervals(f"greedy_success[{state}]", 0, end)
        assert [(each.start.step, each.end and each.end.step) for each in found.intervals] == expected
        total += len(expected)
    assert total > 5
