"""Deployments on a real server: what is refused at submission, and workers that find everything anywhere."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from extrags.errors import ConfigError
from flows.cli import main
from flows.deployments import chosen_deployments, declared_deployments, usual_file
from tests.flows.killing import wait_for
from tests.flows.tiny import SEQUENCE, TINY

REPOSITORY = Path(__file__).parents[2]
PATIENCE_S = 120.0


class TestFile:
    def test_it_is_the_repositorys(self) -> None:
        assert usual_file() == REPOSITORY / "prefect.yaml"
        every = declared_deployments(usual_file())
        found = {item.name: item for item in every if item.flow().name != "retention"}
        assert {"one", "nightly", "weekly"} <= set(found)
        assert found["nightly"].cron == "0 2 * * *"
        assert found["weekly"].parameters["refresh"] is True
        for item in every:
            assert item.concurrency_limit == {"limit": 1, "collision_strategy": "ENQUEUE"}
            assert item.unserved == ()
            assert ":" not in item.entrypoint, "a path is found from a checkout alone"
            assert item.flow().name
            # Its worker knows the store; a default of this side would be a place where it was started.
            store = item.flow().parameters.properties["store"]
            assert store["default"] is None
            assert store["pattern"]

    @pytest.mark.parametrize(("name", "reason"), [("", "Is a directory"), ("a.yaml", "No such file or")])
    def test_what_is_no_file(self, name: str, reason: str, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=f"^{tmp_path / name} cannot be read: {reason}"):
            declared_deployments(tmp_path / name)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("[", "cannot be read"),
            ("a: 1", "declares no deployments"),
            ("deployments: [{name: x}]", "a name and an entrypoint"),
            ("deployments: [{name: x, entrypoint: a.b, schedules: [{interval: 3}]}]", "one schedule at most"),
            ("deployments: [{name: x, entrypoint: a.b, schedules: {cron: '0 2 * * *'}}]", "one schedule at"),
            ("deployments: [{name: x, entrypoint: a.b, schedules: ['0 2 * * *']}]", "one schedule at most"),
            ("deployments: [{name: x, entrypoint: a.b, schedules: [{timezone: UTC}]}]", "cron as a text"),
            ("deployments: [{name: x, entrypoint: a.b, tags: extrags}]", "tags: expected a list"),
            ("deployments: [{name: x, entrypoint: a.b, work_pool: y}]", "deployment x: work_pool: expected"),
        ],
    )
    def test_a_wrong_one_is_refused(self, text: str, message: str, tmp_path: Path) -> None:
        (tmp_path / "file.yaml").write_text(text)
        with pytest.raises(ConfigError, match=message):
            declared_deployments(tmp_path / "file.yaml")

    @pytest.mark.parametrize("entrypoint", ["flows.nothing.at_all", "flows.dataset.log", "flow"])
    def test_an_entrypoint_that_is_no_flow_is_refused(self, entrypoint: str, tmp_path: Path) -> None:
        (tmp_path / "file.yaml").write_text(f"deployments: [{{name: x, entrypoint: {entrypoint}}}]")
        (found,) = declared_deployments(tmp_path / "file.yaml")
        with pytest.raises(ConfigError, match="is no flow"):
            found.flow()


class TestServe:
    def test_wrong_usage(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        monkeypatch.delenv("EXTRAGS_STORE", raising=False)
        assert main(["serve", "nightli"]) == 2
        said = capsys.readouterr().err
        assert "no deployment 'nightli'; known: reconstruct-sequence/one, reconstruct-dataset/nightly" in said
        assert main(["serve", "--limit", "0"]) == 2

    def test_a_name_that_several_flows_have_is_refused(self, capsys: pytest.CaptureFixture[str]) -> None:
        """Otherwise who asks for the weekly benchmark would have the store cleaned as well."""
        assert main(["serve", "nightly", "weekly", "--schedules"]) == 2
        said = capsys.readouterr().err
        assert "'weekly' names 2 deployments; give one of benchmark/weekly, retention/weekly" in said

    def test_each_is_named_by_its_flow_or_where_that_suffices_by_its_name(self) -> None:
        declared = declared_deployments(usual_file())

        def titles(*names: str) -> list[str]:
            return [item.title for item in chosen_deployments(declared, names)]

        assert titles("benchmark/weekly", "nightly") == ["reconstruct-dataset/nightly", "benchmark/weekly"]
        assert titles("retention/weekly") == ["retention/weekly"]
        assert titles("nightly", "reconstruct-dataset/nightly") == ["reconstruct-dataset/nightly"]
        assert len(titles()) == len(declared)
        with pytest.raises(
            ConfigError, match=r"no deployment 'benchmark/nightly'; known: .*retention/weekly"
        ):
            titles("benchmark/nightly")

    @pytest.mark.parametrize("schedules", [False, True])
    def test_what_it_serves(self, schedules: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        from flows.commands.serve import _deployment

        monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
        made = {item.name: item for item in declared_deployments(usual_file())}
        nightly = _deployment(made["nightly"], schedules=schedules)
        assert [item.active for item in nightly.schedules] == [schedules]
        assert nightly.entrypoint == "flows.dataset.reconstruct_dataset"
        assert nightly.concurrency_limit == 1
        assert _deployment(made["one"], schedules=schedules).schedules == []

    def test_what_the_file_says_of_further_runs_and_of_the_environment(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("EXTRAGS_STORE", "/data/special")
        served = served_from(
            tmp_path,
            "concurrency_limit: {limit: 2, collision_strategy: CANCEL_NEW}",
            "work_pool: {name: local, job_variables: {env: {EXTRAGS_STORE: /data/special}}}",
            "version: null",
        )
        assert served.concurrency_limit == 2
        assert served.concurrency_options.collision_strategy == "CANCEL_NEW"
        assert served_from(tmp_path, "concurrency_limit: 3").concurrency_limit == 3
        assert served_from(tmp_path, "concurrency_limit: {limit: null}").concurrency_limit is None
        (when,) = served_from(
            tmp_path, "schedules: [{cron: '0 2 * * *', timezone: Europe/Zurich}]", "tags: [night]"
        ).schedules
        assert (when.schedule.cron, when.schedule.timezone) == ("0 2 * * *", "Europe/Zurich")

    @pytest.mark.parametrize(
        ("line", "field"),
        [
            (
                "work_pool: {job_variables: {env: {EXTRAGS_STORE: /other}}}",
                r"job_variables\.env\.EXTRAGS_STORE",
            ),
            ("work_pool: {job_variables: {image: extrags}}", r"work_pool\.job_variables\.image"),
            ("version: 3", "version"),
            (
                "concurrency_limit: {limit: 1, collision_strategy: DROP}",
                r"concurrency_limit\.collision_strategy",
            ),
            ("concurrency_limit: {limit: 1, strategy: ENQUEUE}", r"concurrency_limit\.strategy"),
            ("schedules: [{cron: '0 2 * *'}]", 'schedules: .*Invalid cron string: "0 2'),
            ("schedules: [{cron: '0 2 * * *', timezone: Europe/Bern}]", "schedules: .*Invalid timezone"),
            ("parameters: {sequence: phantom/0, settingz: {}}", r"parameters\.settingz: .*settings"),
            ("parameters: {profile: quik}", r"parameters\.profile: 'quik' is not one of \['quick'"),
            (
                "parameters: {settings: {coarse.iterations: 0}}",
                r"parameters\.settings\['coarse\.iterations'\]: 0 is less than the minimum of 1$",
            ),
            (
                "parameters: {settings: {coarse.iteration: 3}}",
                r"parameters\.settings: 'coarse\.iteration' is",
            ),
        ],
    )
    def test_what_it_cannot_go_by_is_refused(
        self, line: str, field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("EXTRAGS_STORE", "/data/special")
        with pytest.raises(ConfigError, match=rf"own\.yaml: deployment mine: .*{field}"):
            served_from(tmp_path, line)

    def test_where_the_server_refuses_one_none_stays_on_its_schedule(
        self,
        prefect_server: None,
        untouched_environment: None,
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        from prefect.client.orchestration import get_client
        from prefect.deployments.runner import DeploymentApplyError, RunnerDeployment

        apply = RunnerDeployment.apply

        def refused(deployment: RunnerDeployment) -> Any:
            if deployment.name == "second":
                raise DeploymentApplyError("1 validation error\n" + "a page of schema\n" * 10000)
            return apply(deployment)

        monkeypatch.setattr(RunnerDeployment, "apply", refused)
        entry = (
            "{name: %s, entrypoint: flows.sequence.reconstruct_sequence, schedules: [{cron: '0 2 * * *'}]}"
        )
        file = tmp_path / "own.yaml"
        file.write_text(f"deployments: [{entry % 'first'}, {entry % 'second'}]")
        assert main(["serve", "--file", str(file), "--schedules"]) == 2
        said = capsys.readouterr().err
        assert said == f"extrags: {file}: deployment second: the server refuses it: 1 validation error\n"
        with get_client(sync_client=True) as client:
            first = client.read_deployment_by_name("reconstruct-sequence/first")
            client.delete_deployment(first.id)
        assert first.paused
        assert [item.active for item in first.schedules] == [True]


class TestSchedule:
    def test_the_server_schedules_runs(self, prefect_server: None, monkeypatch: pytest.MonkeyPatch) -> None:
        """By its own service, on its own database: there it broke with SQLAlchemy 2.1, in its log alone."""
        from prefect.client.orchestration import get_client
        from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterId
        from prefect.server.services.scheduler import schedule_deployments

        from flows.commands.serve import _deployment

        monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
        (nightly,) = chosen_deployments(declared_deployments(usual_file()), ["nightly"])
        deployed = _deployment(nightly, schedules=True).apply()
        with get_client(sync_client=True) as client:
            try:
                asyncio.run(schedule_deployments())
                own = DeploymentFilter(id=DeploymentFilterId(any_=[deployed]))
                runs = client.read_flow_runs(deployment_filter=own)
                assert {run.state_name for run in runs} == {"Scheduled"}
                assert {run.expected_start_time.hour for run in runs if run.expected_start_time} == {2}
            finally:
                # With the runs that it has to come.
                client.delete_deployment(deployed)


def served_from(folder: Path, *lines: str) -> Any:
    """The deployment that `extrags serve` makes of a file of one's own."""
    from flows.commands.serve import _deployment

    fields = ["name: mine", "entrypoint: flows.sequence.reconstruct_sequence", *lines]
    file = folder / "own.yaml"
    file.write_text("\n".join(["deployments:", "  -", *(f"    {line}" for line in fields)]))
    (declared,) = declared_deployments(file)
    return _deployment(declared, schedules=False)


@contextmanager
def process(
    command: list[str], folder: Path, environment: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """A process in a session of its own, which is ended with it."""
    log = folder / f"{Path(command[0]).name}-{command[1]}.log"
    with log.open("wb") as out:
        started = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )
    try:
        yield started
    except BaseException:
        print(log.read_text(errors="replace")[-6000:])
        raise
    finally:
        try:
            os.killpg(started.pid, signal.SIGTERM)
            started.wait(timeout=15)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
            started.wait()
        except ProcessLookupError:
            started.wait()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("operator")


@pytest.fixture(scope="module")
def environment(place: Path) -> Iterator[dict[str, str]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")},
        "PREFECT_HOME": str(place / "home"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_CLI_PROMPT": "false",
        "PREFECT_CLI_COLORS": "false",
        "OMP_NUM_THREADS": "1",
        "OMP_WAIT_POLICY": "passive",
        "COLUMNS": "2000",
    }
    environment.pop("EXTRAGS_STORE", None)
    server = [prefect(), "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"]
    with process(server, place, environment):
        wait_for(lambda: is_up(environment), "the server", PATIENCE_S, every_s=0.25)
        yield environment


@pytest.fixture(scope="module")
def deployed(place: Path, environment: dict[str, str]) -> dict[str, str]:
    for command in (
        ["work-pool", "create", "local", "--type", "process"],
        ["--no-prompt", "deploy", "--all"],
    ):
        done = call([prefect(), *command], REPOSITORY, environment)
        assert done.returncode == 0, done.stdout
    return environment


@pytest.mark.slow
@pytest.mark.timeout(600)
class TestRealServer:
    """A server, a worker and `extrags serve` as an operator starts them, each in a directory of its own."""

    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({"coarse.iteration": 500}, "'coarse.iteration' is not one of ['coarse.iterations'"),
            ({"coarse.iterations": 0}, "field \"settings['coarse.iterations']\""),
            ({"coars.iterations": 5}, "'coars.iterations' does not match '^(ingest|poses|depth|coarse|"),
            ({"enhance.backend": "clasical"}, "'clasical' is not one of ['embedded', 'classical'"),
        ],
    )
    def test_a_wrong_setting_is_refused_before_there_is_a_run(
        self, deployed: dict[str, str], settings: dict[str, Any], said: str
    ) -> None:
        before = runs_of(deployed)
        done = run_deployment(deployed, "reconstruct-sequence/one", settings=settings)
        assert done.returncode != 0
        assert said in done.stdout
        assert runs_of(deployed) == before

    def test_a_relative_store_is_refused_before_there_is_a_run(self, deployed: dict[str, str]) -> None:
        before = runs_of(deployed)
        done = run_deployment(deployed, "reconstruct-sequence/one", store=".extrags")
        assert done.returncode != 0
        assert "field 'store'" in done.stdout
        assert runs_of(deployed) == before

    def test_a_worker_elsewhere_finds_store_and_data(self, deployed: dict[str, str], place: Path) -> None:
        elsewhere = place / "worker"
        elsewhere.mkdir()
        environment = {**deployed, "EXTRAGS_STORE": str(place / "store")}
        worker = [prefect(), "worker", "start", "--pool", "local", "--type", "process"]
        with process(worker, elsewhere, environment):
            done = run_deployment(
                deployed, "reconstruct-sequence/one", settings=TINY, until="coarse", sequence=SEQUENCE
            )
            assert done.returncode == 0, done.stdout
            assert finished(deployed, name=SEQUENCE) == "COMPLETED"
        assert len(list((place / "store" / "artefacts").iterdir())) >= 2
        # One record of what was used, beside that of the outcome.
        assert len(list((place / "store" / "records").glob("run-*"))) == 1
        assert not list(elsewhere.rglob("artefacts"))

    def test_serve_runs_them_without_a_pool(self, deployed: dict[str, str], place: Path) -> None:
        elsewhere = place / "served"
        elsewhere.mkdir()
        command = [extrags(), "serve", "nightly", "--store", str(place / "served-store")]
        with process(command, elsewhere, deployed):
            log = elsewhere / "extrags-serve.log"
            wait_for(lambda: "being served" in log.read_text(), "extrags serve", PATIENCE_S, every_s=0.25)
            assert [item["active"] for item in deployment(deployed, "nightly")["schedules"]] == [False]
            done = run_deployment(
                deployed,
                "reconstruct-dataset/nightly",
                settings=TINY,
                until="coarse",
                sequences=["phantom/[01]@sparse"],
                name="served",
            )
            assert done.returncode == 0, done.stdout
            assert finished(deployed, name="served") == "COMPLETED"
        # One record of each outcome, beside those of what was used.
        assert len(list((place / "served-store" / "records").glob("outcome.*"))) == 2
        said = call(
            [extrags(), "status", "--store", str(place / "served-store"), "--json", "-"], place, deployed
        )
        assert json.loads(said.stdout)["counts"] == {"done": 2}


def prefect() -> str:
    return str(Path(sys.executable).with_name("prefect"))


def extrags() -> str:
    return str(Path(sys.executable).with_name("extrags"))


def call(command: list[str], folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )


def run_deployment(
    environment: dict[str, str], of: str, /, **parameters: Any
) -> subprocess.CompletedProcess[str]:
    given = [part for key, value in parameters.items() for part in ("--param", f"{key}={json.dumps(value)}")]
    return call([prefect(), "deployment", "run", of, *given], REPOSITORY, environment)


def is_up(environment: dict[str, str]) -> bool:
    try:
        return httpx.get(f"{environment['PREFECT_API_URL']}/health").status_code == 200
    except httpx.TransportError:
        return False


def asked(environment: dict[str, str], path: str, question: dict[str, Any]) -> Any:
    return httpx.post(f"{environment['PREFECT_API_URL']}/{path}", json=question, timeout=30).json()


def runs_of(environment: dict[str, str]) -> int:
    return int(asked(environment, "flow_runs/count", {}))


def deployment(environment: dict[str, str], name: str) -> dict[str, Any]:
    (found,) = asked(environment, "deployments/filter", {"deployments": {"name": {"any_": [name]}}})
    return dict(found)


def finished(environment: dict[str, str], *, name: str) -> str:
    """The type of the last state of a run."""

    def state() -> str | None:
        runs = asked(environment, "flow_runs/filter", {"flow_runs": {"name": {"any_": [name]}}})
        types = [run["state_type"] for run in runs]
        return types[0] if types and types[0] in ("COMPLETED", "FAILED", "CRASHED", "CANCELLED") else None

    return str(wait_for(state, name, PATIENCE_S, every_s=0.25))
