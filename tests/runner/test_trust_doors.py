"""Every command and every route, with recordings that strangers made: nothing of theirs is imported or made.

A command or a route that is new fails these tests until it is in the tables: `COMMANDS` has the arguments of
each command that reads a run, `WITHOUT_RUN` the others; routes are requested with the parameters in `FILLED`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import sys
from pathlib import Path

import gymnasium
import pytest
from click.testing import CliRunner
from gymnasium.envs.classic_control import CartPoleEnv
from starlette.testclient import TestClient

import runner
from runner.cli import cli
from runner.cli.views import command_of
from runner.config.model import identity_of
from runner.errors import CannotRedo, RunnerError
from runner.execution.resume import resume
from runner.execution.verify import verify
from runner.recording.maker import EnvironmentMaker, VectorMaker
from runner.recording.reader import open_recording
from runner.recording.rewriting import rewrite
from runner.replay.environment import rerun
from runner.replay.makers import make_environment, make_vector
from runner.replay.trust import require_listed
from runner.runs.run import Run
from runner.runs.trust_marks import MARK_FILE
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from runner.views import shipped_views
from runner.views.view import ONLY_HERE, View
from tests.doors import commands, routes

pytestmark = pytest.mark.long

TRAP = """\
from pathlib import Path
Path(__file__).with_name("IMPORTED").touch()
import gymnasium
gymnasium.register("Trap-v0", entry_point="gymnasium.envs.classic_control.cartpole:CartPoleEnv")
def make(render_mode=None):
    return gymnasium.make("CartPole-v1", render_mode=render_mode)
def policy(weights, *spaces):
    return lambda observation: 0
parallel_env = Env = Wrapper = make
"""


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """Return the folder of a module that leaves a file when it is imported; it is the current one, too."""
    folder = tmp_path / "traps" / "current"
    folder.mkdir(parents=True)
    (folder / "trap.py").write_text(TRAP)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "modules", sys.modules)
    yield folder
    sys.modules.pop("trap", None)


def untouched(trap, *ours):
    """Return whether no trap was imported, and nothing written next to it or above."""
    found = {path.name for folder in (trap, trap.parent) for path in folder.iterdir()}
    return found - {*ours, "__pycache__"} == {"current", "trap.py"}


@pytest.fixture(scope="module")
def pole(tmp_path_factory):
    """Return a recorded loop of a known environment, with a checkpoint."""
    folder = tmp_path_factory.mktemp("pole")
    with runner.record(gymnasium.make("CartPole-v1"), folder, name="pole") as env:
        env.action_space.seed(0)
        env.reset(seed=1)
        for _ in range(40):
            if any(env.step(env.action_space.sample())[2:4]):
                env.reset()
        env.checkpoint("policy", b"weights")
    return env.run


@pytest.fixture(scope="module")
def maker(pole):
    with open_recording(pole.recording) as recording:
        return recording.maker


def changed(maker, vector=None, **spec):
    return dataclasses.replace(maker, spec=json.dumps(json.loads(maker.spec) | spec), vector=vector)


def wrapped(entry_point, name="TimeLimit", **kwargs):
    return [{"name": name, "entry_point": entry_point, "kwargs": kwargs}]


def game(entry_point, **kwargs):
    return EnvironmentMaker("pettingzoo", json.dumps({"entry_point": entry_point, "kwargs": kwargs}))


def hostile(maker):
    """Return makers of each kind of hostility, by name."""
    vector = VectorMaker(2, "sync", "NextStep")
    wrappers = {
        "a class": wrapped("trap:Wrapper"),
        "that prints": wrapped("pettingzoo.utils.wrappers:CaptureStdoutWrapper"),
        "of a listed name": wrapped("gymnasium.utils.play:TimeLimit"),
        "of a listed name, in a package": wrapped("gymnasium.envs.registration:TimeLimit"),
        "that calls": wrapped("gymnasium.wrappers:TransformReward", func="trap:make"),
        "that shows": wrapped("gymnasium.wrappers:ObstructView"),
        "with words": wrapped("gymnasium.wrappers:TimeLimit", max_episode_steps="trap.py"),
        "with a file": wrapped("gymnasium.wrappers:FrameStackObservation", stack_size=2, padding_type="/x"),
    }
    return {
        **{f"wrapper {name}": changed(maker, additional_wrappers=value) for name, value in wrappers.items()},
        **{
            f"vector wrapper {name}": changed(
                maker, dataclasses.replace(vector, wrapper_specs=json.dumps(value))
            )
            for name, value in wrappers.items()
        },
        "argument that names code": changed(maker, kwargs={"config": {"other_vehicles_type": "trap.Env"}}),
        "argument that is a word": changed(maker, kwargs={"sutton_barto_reward": "trap"}),
        "argument with a key that is a word": changed(maker, kwargs={"options": {"trap": 1}}),
        "entry point": changed(maker, entry_point="trap:Env"),
        "registered by a trap": dataclasses.replace(changed(maker, id="Trap-v0"), registered_by="trap"),
        "registered by a part of a package": dataclasses.replace(maker, registered_by="gymnasium.utils.play"),
        "id with a module": changed(maker, id="trap:CartPole-v1"),
        "function": dataclasses.replace(maker, make="trap:make", spec=""),
        "class of the script": changed(maker, entry_point="__main__:Env"),
        "game": game("trap:parallel_env"),
        "function of a game": game("pettingzoo.utils.conversions:aec_to_parallel"),
        "game by the name of one": game("gymnasium.utils.play:env"),
        "game with a path": game("mpe2.simple_spread_v3:parallel_env", render_mode="trap", N="trap.py"),
    }


KINDS = sorted(hostile(EnvironmentMaker("gymnasium", "{}")))


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_of_hostility_is_made(kind, maker, trap):
    one = hostile(maker)[kind]
    make = make_vector if one.vector else make_environment
    with pytest.raises(CannotRedo, match=r"--trust|another environment|id without a module|script"):
        make(one, trust=False).close()
    assert untouched(trap)


def test_what_only_shows_pictures_is_left_out_by_its_entry_point(maker, trap):
    for entry_point in ("gymnasium.wrappers:RecordVideo", "gymnasium.wrappers.vector.rendering:RecordVideo"):
        video = wrapped(entry_point, "Foo", video_folder="..")
        make_environment(changed(maker, additional_wrappers=video), trust=False).close()
        vector = VectorMaker(2, "sync", "NextStep", wrapper_specs=json.dumps(video))
        make_vector(changed(maker, vector), trust=False).close()
    named = changed(maker, additional_wrappers=wrapped("trap:Wrapper", "RecordVideo"))
    with pytest.raises(CannotRedo, match="--trust"):
        make_environment(named, trust=False)
    assert untouched(trap)


def test_plain_arguments_and_listed_wrappers_are_made(maker):
    kwargs = {"sutton_barto_reward": True, "render_mode": "human"}
    wrappers = wrapped("gymnasium.wrappers.stateful_observation:FrameStackObservation", stack_size=2)
    env = make_environment(changed(maker, kwargs=kwargs, additional_wrappers=wrappers), trust=False)
    assert env.observation_space.shape == (2, 4)
    icy = EnvironmentMaker("gymnasium", gymnasium.make("FrozenLake-v1", desc=["SF", "FG"]).spec.to_json())
    assert make_environment(icy, trust=False).observation_space.n == 4


# --- whole recordings ---------------------------------------------------------------------------------


def forged(run: Run, folder: Path, name: str, change, mark: str | None = None) -> Run:
    """Write a copy of a run with other metadata and a mark that does not hold; return it."""
    target = folder / name
    target.mkdir(parents=True)
    facts = run.facts | {"run_id": name, "name": name}
    rewrite(run.recording, target / "recording.mcap", change)
    with open_recording(target / "recording.mcap") as recording:
        facts["config"] = recording.config
    (target / "run.json").write_text(json.dumps(facts))
    text = (run.folder / MARK_FILE).read_text() if mark is None else mark
    (target / MARK_FILE).write_text(text)
    return Run(target, facts)


def with_maker(maker):
    return lambda name, entries: maker.to_metadata() if name == "environment_maker" else entries


def of_another_job(name, entries):
    """Return a job's metadata with an environment that imports a trap."""
    if name == "config":
        config = json.loads(entries["json"])
        config["env"]["id"] = f"trap:{config['env']['id'].rpartition(':')[2]}"
        return {"json": json.dumps(config, sort_keys=True)}
    return entries


@pytest.fixture(scope="module")
def strangers(tmp_path_factory, pole, lake, maker):
    """Return a recordings folder with a loop that names code, one that writes, and a job that imports."""
    folder = tmp_path_factory.mktemp("strangers")
    forged(pole, folder, "function", with_maker(hostile(maker)["function"]))
    video = wrapped("gymnasium.wrappers.vector:RecordVideo", "Foo", video_folder="..")
    forged(pole, folder, "writing", with_maker(changed(maker, additional_wrappers=video)), mark="{}")
    with open_recording(lake.recording) as recording:
        config = json.loads(of_another_job("config", recording.file.metadata("config"))["json"])
        job = identity_of(config, recording.seed)

    def change(name, entries):
        return entries | {"job": job} if name == "run" else of_another_job(name, entries)

    forged(lake, folder, "job", change)
    forged(pole, folder, "known", lambda _, entries: entries, mark="{}")
    return folder


COMMANDS = {
    "branch": ["RUN", "--at", "0:1", "--action", "1"],
    "checkpoint get": ["RUN", "@0", "-o", "OUT"],
    "checkpoints": ["RUN"],
    "code": ["RUN"],
    "compare": ["RUN", "RUN"],
    "console": ["RUN"],
    "diff": ["RUN", "RUN"],
    "du": [],
    "episodes": ["RUN"],
    "evaluations": ["RUN"],
    "evaluate": ["RUN", "--checkpoint", "policy@40", "--policy", "policy_of_doors:policy", "--trials", "1"],
    "explain": ["RUN", "tutorial_cooperative", "--dry-run", "--seeds", "1"],
    "export csv": ["RUN", "-o", "OUT"],
    "export film": ["RUN", "--episode", "0", "-o", "OUT.gif"],
    "export mcap": ["RUN", "-o", "OUT.mcap"],
    "export minari": ["RUN"],
    "export parquet": ["RUN", "-o", "OUT"],
    "export rerun": ["RUN", "--episode", "0", "-o", "OUT.rrd"],
    "export tensorboard": ["RUN", "-o", "OUT"],
    "import": ["RECORDING"],
    "ls": [],
    "mark": ["RUN", "0:1", "seen"],
    "play": ["RUN", "--episode", "0"],
    "plot": ["RUN", "-o", "OUT.svg"],
    "qtable": ["RUN"],
    "repair": ["RUN"],
    "report": ["RUN", "-o", "OUT.html"],
    "rerecord": ["RUN"],
    "resume": ["RUN", "--accept-changes"],
    "show": ["RUN"],
    "find": ["any(reward < 0)"],
    "sql": ["SELECT * FROM steps"],
    "system": ["RUN"],
    "values": ["RUN", "--episode", "0", "--checkpoint", "policy@40", "--policy", "policy_of_doors:policy"],
    "verify": ["RUN", "--rerun"],
    "view": ["RUN", "--episode", "0"],
    "when": ["RUN", "q[0, 0] > 1"],
    "why": ["RUN", "--state", "0", "--action", "0"],
}
"""The commands that read a run, with arguments that make its environment where they make any."""
WITHOUT_RUN = frozenset(
    {
        *("archive", "completion", "config check", "config copy", "config ls", "config schema"),
        *(
            "index rebuild",
            "init",
            "label",
            "prune",
            "remote cancel",
            "remote jobs",
            "remote pull",
        ),
        *("remote push", "remote resume", "remote submit", "remote watch", "restore", "rm"),
        *("run", "serve", "sweep ls", "sweep run", "sweep show", "table"),
        *("token create", "token ls", "token revoke"),
    }
)
"""Commands that copy files or numbers, talk to a server, or do what a file of the user's own says."""


def test_every_command_is_walked_or_reads_no_run():
    assert sorted(map(" ".join, commands())) == sorted([*COMMANDS, *WITHOUT_RUN])


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_no_command_makes_what_a_stranger_chose(name, strangers, trap, tmp_path, monkeypatch):
    (tmp_path / "policy_of_doors.py").write_text("def policy(*_):\n    return lambda observation: 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("runner.export.rerun.viewer.viewer", None)
    for run in ("function", "writing", "job"):
        own = shutil.copytree(strangers, tmp_path / run / "runs")
        filled = {"RUN": run, "RECORDING": str(strangers / run / "recording.mcap")}
        words = [
            filled.get(word, word.replace("OUT", str(tmp_path / run / "out"))) for word in COMMANDS[name]
        ]
        done = CliRunner().invoke(cli, [*name.split(), *words], env={"DUALTAXI_RECORDINGS": str(own)})
        assert done.exception is None or isinstance(done.exception, SystemExit), (run, done.output)
        assert untouched(trap, "exports"), (run, done.output)


def test_with_trust_the_traps_are_imported(strangers, trap):
    """Show that the other tests would notice."""
    recording = strangers / "function" / "recording.mcap"
    assert "--trust" in verify(recording).reason
    assert untouched(trap)
    assert verify(recording, trust=True).verdict == "reproduced"
    assert (trap / "IMPORTED").exists()


def test_options_of_a_reset_are_numbers_unless_the_run_is_trusted(tmp_path, monkeypatch):
    """An environment may look up what options name: `highway_env` imports classes of vehicles."""
    got = []
    original = CartPoleEnv.reset

    def reset(env, *, seed=None, options=None):
        got.append(options)
        return original(env, seed=seed, options=options)

    monkeypatch.setattr(CartPoleEnv, "reset", reset)
    for options in ({"low": -0.01, "high": 0.01}, {"config": {"other_vehicles_type": "trap.Env"}}):
        with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as env:
            env.reset(seed=1, options=options)
            env.step(0)
        got.clear()
        with open_recording(env.run.recording) as recording:
            assert all(s.difference is None for s in rerun(recording))
            assert got == [options]
            (env.run.folder / MARK_FILE).unlink()
            got.clear()
            if "config" in options:
                with pytest.raises(CannotRedo, match=r"option of a reset, config=.*--trust"):
                    list(rerun(recording))
            else:
                assert all(s.difference is None for s in rerun(recording))
            assert got == [options] * ("low" in options)


def test_an_interrupted_job_is_resumed_only_as_its_recording_allows(strangers, lake, trap, tmp_path):
    own = Path(shutil.copytree(strangers / "job", tmp_path / "job"))
    size = (own / "recording.mcap").stat().st_size
    os.truncate(own / "recording.mcap", size // 2)
    facts = json.loads((own / "run.json").read_text())
    facts |= {"config": lake.facts["config"], "status": "interrupted"}
    (own / "run.json").write_text(json.dumps(facts))
    with pytest.raises(CannotRedo, match="--trust"):
        resume(Run(own, facts), accept_changes=True)
    assert untouched(trap)


def test_a_known_environment_of_a_stranger_is_made(strangers):
    assert verify(strangers / "known" / "recording.mcap").verdict == "reproduced"


def test_of_golden_runs_the_environment_is_the_tests_own(strangers, trap):
    with open_recording(strangers / "function" / "recording.mcap") as recording:
        assert all(s.difference is None for s in rerun(recording, make=lambda: gymnasium.make("CartPole-v1")))
    assert untouched(trap)


# --- the service --------------------------------------------------------------------------------------

FILLED = {
    "run": None,
    "action": "0",
    "after": "0",
    "at": "0:1",
    "digest": "0" * 32,
    "episode": "0",
    "form": "svg",
    "metric": "mean_return",
    "name": "name",
    "name:path": "name",
    "number": "1",
    "pair": "pair",
    "part": "head",
    "phase": "train",
    "table": "steps",
    "trial": "0",
    "upload_id": "0" * 32,
}
"""Parameters of routes: None for the id of a run."""
BODIES = {
    "POST /runs/{run}/branch": {"at": "0:1", "action": "0"},
    "POST /runs/{run}/archive": {},
    "POST /runs/{run}/film": {},
    "POST /runs/{run}/labels": {},
    "POST /runs/{run}/marks": {"at": "0:1"},
    "DELETE /runs/{run}/marks/{name}": {},
    "POST /runs/{run}/replay/mark": {},
    "POST /runs/{run}/remove": {},
    "POST /runs/{run}/stop": {},
    "PATCH /runs/{run}": {"note": "x"},
}
"""What is sent to the routes that change a run; the other ones that change something are of no run."""
OF_NO_RUN = frozenset(
    {
        *("POST /explain", "POST /explanations", "POST /jobs", "POST /jobs/check", "POST /submit"),
        *("POST /jobs/{number}/cancel", "POST /jobs/{number}/resume", "POST /login", "POST /logout"),
        *("POST /queue/{number}/cancel", "POST /queue/{number}/resume"),
        *("DELETE /uploads/{upload_id}", "PATCH /uploads/{upload_id}", "PUT /uploads/{upload_id}"),
    }
)
ENDLESS = ("/events",)


@pytest.fixture
def service(strangers, tmp_path, trap):
    """Return a service of a copy of the strangers' recordings, which starts where the traps are."""
    own = Path(shutil.copytree(strangers, tmp_path / "runs"))
    app = create_app(ServiceSettings((own,), tokens=tmp_path / "tokens.json", workers=1))
    here = {"base_url": "http://localhost", "headers": {"Origin": "http://localhost"}}
    with TestClient(app, raise_server_exceptions=False, **here) as client:
        yield client


def test_no_route_makes_what_a_stranger_chose(service, trap):
    seen = {
        f"{method} {path}" for method, path in routes(service.app.routes) if method not in ("GET", "HEAD")
    }
    assert seen == {*BODIES, *OF_NO_RUN}
    texts = []
    for method, path in sorted(set(routes(service.app.routes))):
        if method == "HEAD" or path.endswith(ENDLESS) or f"{method} {path}" in OF_NO_RUN:
            continue
        draws = any(word in path for word in ("replay", "pictures", "branch"))
        for run in ("function", "job", "writing")[: 2 + draws] if "{run}" in path else [""]:
            values = {name: value or run for name, value in FILLED.items()}
            address = path.replace("name:path", "name").format_map(values)
            for prefix in ("",) if path.startswith("/api") else ("", "/api/v1"):
                answer = service.request(
                    method,
                    prefix + address,
                    params={"run": "job", "a": run, "b": run, "start": 0, "steps": 3, "episode": 0},
                    json=BODIES.get(f"{method} {path}"),
                )
                assert answer.status_code < 500 or answer.status_code == 501, (address, answer.text)
                assert untouched(trap), address
                texts.append(answer.text if "text" in answer.headers.get("content-type", "") else "")
    assert "--trust" not in "".join(texts)


def test_an_id_without_a_version_is_judged_as_the_environment_that_it_stands_for():
    require_listed("CartPole", {"sutton_barto_reward": True})
    with pytest.raises(CannotRedo, match="keyword argument of CartPole"):
        require_listed("CartPole", {"config": "trap.Env"})


def test_of_a_strangers_loop_the_service_makes_not_even_a_known_environment(service):
    answer = service.get("/api/v1/runs/known/replay/train/0/pictures", params={"start": 0, "steps": 3})
    assert b"was not recorded by the user who runs this server" in answer.content


@pytest.mark.parametrize("env", [{"id": "trap:CartPole-v1"}, {"id": "Taxi-v4", "kwargs": {"x": "trap"}}])
def test_no_job_of_a_client_makes_what_is_not_listed(env, service, trap):
    config = {"name": "mine", "env": env, "episodes": 3}
    sweep = {"base": config, "parameters": {"discount": [0.9, 0.8]}, "seeds": [0], "strategy": "grid"}
    listed = sweep | {"base": config | {"env": {"id": "Taxi-v4"}}}
    second = listed | {"parameters": {"env": [{"id": "Taxi-v4"}, env]}}
    for text in (config, sweep, second):
        answer = service.post("/api/v1/jobs/check", content=json.dumps(text))
        assert answer.status_code == 422, answer.text
        assert "--trust" not in answer.text
    assert untouched(trap)
    with contextlib.suppress(ModuleNotFoundError):
        assert "trap" not in sys.modules


def test_a_view_that_takes_code_or_a_path_is_a_command_only(service):
    def made(recording, policy=ONLY_HERE):
        """Make what the policy says."""

    here = {view.name for view in shipped_views() if not view.is_served}
    own_pages = {"find", "sql"}
    assert here == own_pages | {"du", "ls", "show", "sweep ls", "sweep show", "table", "values", "verify"}
    assert not View("made", "Made", made).is_served

    def wrong(recording, code=ONLY_HERE):
        """Take what no command shares."""

    with pytest.raises(RunnerError, match="wrong: found 'code' with ONLY_HERE, expected one of words, "):
        command_of(View("wrong", "Wrong", wrong))
    paths = {path for _, path in routes(service.app.routes)}
    assert {path for path in paths if path.rpartition("/")[2].partition(".")[0] in here - own_pages} == set()
