"""The command line: verbs, exit codes, messages, JSON."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import httpx
import pytest

from extrags.config import PROFILES, PipelineConfig
from extrags.config.settings import settings_of
from extrags.errors import ConfigError, MissingDependencyError
from flows.cli import VERBS, main, parser
from flows.commands.common import parsed_settings, run_config
from flows.outcome import SequenceOutcome
from tests.data_catalog.test_images import write_png_header
from tests.documented_json import undocumented
from tests.flows.tiny import SEQUENCE, settled

pytestmark = pytest.mark.usefixtures("untouched_environment")


def shell(command: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """What a command says in a process of its own, with the redirections of a shell."""
    code = "import sys; from flows.cli import main; sys.exit(main())"
    return subprocess.run(
        ["sh", "-c", f"{sys.executable} -c '{code}' {command}"],
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        check=False,
    )


class TestStart:
    def test_help_loads_nothing_heavy(self) -> None:
        code = (
            "import sys\n"
            "from flows.cli import main\n"
            "try: main(['--help'])\n"
            "except SystemExit: pass\n"
            "print(sorted({'torch', 'prefect', 'zarr', 'numpy', 'pydantic'} & set(sys.modules)))\n"
        )
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert said.stdout.rstrip().endswith("[]")
        assert "extrags run phantom/0@sparse" in said.stdout

    @pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["data", "list"]])
    def test_a_reader_that_goes_is_no_failure(self, arguments: list[str]) -> None:
        reading, writing = os.pipe()
        os.close(reading)
        code = "import sys\nfrom flows.cli import main\nsys.exit(main())"
        command = [sys.executable, "-c", code, *arguments]
        said = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
        os.close(writing)
        assert (said.returncode, said.stderr) == (0, "")

    @pytest.mark.parametrize(
        "closed",
        [
            pytest.param(">&-", marks=pytest.mark.slow),
            pytest.param("2>&-", marks=pytest.mark.slow),
            ">&- 2>&-",
        ],
    )
    def test_closed_streams_change_no_exit_code(self, closed: str, tmp_path: Path) -> None:
        for verb, code in (("status", 0), ("cache ls", 0), ("cache nonsense", 2)):
            said = shell(f'{verb} --store "{tmp_path}" {closed}')
            assert (said.returncode, "Traceback" in said.stdout + said.stderr) == (code, False), verb

    @pytest.mark.parametrize("verb", ["--help", "--version", "data list", "data list --json -"])
    def test_a_full_device_is_one_sentence(self, verb: str) -> None:
        said = shell(f"{verb} >/dev/full")
        assert said.returncode == 1
        assert said.stderr == "extrags: standard output cannot be written: No space left on device\n"
        assert shell(f"{verb} >/dev/full 2>/dev/full").returncode == 1

    @pytest.mark.parametrize("verb", ["run phantom/0@sparse", "cache gc", "report phantom/0@sparse"])
    def test_without_a_home_folder_one_sentence_names_the_variable(self, verb: str, tmp_path: Path) -> None:
        code = (
            "import os, pwd, sys\n"
            "del os.environ['HOME']\n"
            "def unknown(*_): raise KeyError('uid not found')\n"
            "pwd.getpwuid = unknown\n"
            "from flows.cli import main\n"
            "sys.exit(main())\n"
        )
        command = [sys.executable, "-c", code, *verb.split(), "--store", str(tmp_path)]
        said = subprocess.run(command, capture_output=True, text=True, check=False)
        assert said.returncode == 2
        assert (
            said.stderr
            == "extrags: no home folder is known of this user; set HOME to a folder that can be written\n"
        )

    def test_what_libraries_warn_of_is_not_said(self, tmp_path: Path) -> None:
        """Pillow warns of images of more than 89 million pixels, once for each."""
        for number in range(8):
            write_png_header(tmp_path / f"{number}.png", 13_000, 13_000)
        for option in ("", "-q"):
            said = shell(f'data check "{tmp_path}" {option}', {"PYTHONWARNINGS": ""})
            assert (said.returncode, said.stderr) == (1, "")

    @pytest.mark.parametrize("encoding", [pytest.param("latin-1", marks=pytest.mark.slow), "ascii"])
    def test_any_encoding_will_do(self, encoding: str, tmp_path: Path) -> None:
        said = shell(f'status --store "{tmp_path}"', {"PYTHONIOENCODING": encoding})
        assert said.returncode == 0
        assert "+ done   - skipped   x failed   . missing   > running" in said.stdout
        (tmp_path / "€").mkdir()
        said = shell(f'status --store "{tmp_path}/€"', {"PYTHONIOENCODING": encoding})
        assert "0 artefacts in" in said.stdout
        assert "/\\u20ac" in said.stdout

    def test_data_and_cache_load_no_torch_and_no_prefect(self, tmp_path: Path) -> None:
        code = (
            "import sys\n"
            "from flows.cli import main\n"
            f"main(['data', 'list']); main(['cache', 'ls', '--store', {str(tmp_path)!r}])\n"
            "print(sorted({'torch', 'prefect', 'open3d'} & set(sys.modules)))\n"
        )
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert said.stdout.rstrip().endswith("[]")
        assert "phantom/0@sparse" in said.stdout

    def test_the_help_of_a_verb_loads_no_torch_and_no_prefect(self) -> None:
        code = (
            "import sys\n"
            "from flows.cli import VERBS, main\n"
            "for verb in VERBS:\n"
            "    try: main([verb, '--help'])\n"
            "    except SystemExit: pass\n"
            "print(sorted({'torch', 'prefect', 'zarr', 'numpy', 'open3d'} & set(sys.modules)))\n"
        )
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert said.stdout.rstrip().endswith("[]")

    @pytest.mark.parametrize(("words", "meant"), [(["rum", "phantom/0"], "run"), (["cache", "lss"], "ls")])
    def test_a_misspelt_verb(self, words: list[str], meant: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(words) == 2
        assert f"; did you mean {meant}? (see extrags" in capsys.readouterr().err

    def test_no_verb_shows_help(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main([]) == 2
        assert "verbs" in capsys.readouterr().out

    def test_version(self, capsys: pytest.CaptureFixture[str]) -> None:
        from extrags import __version__

        assert main(["--version"]) == 0
        assert capsys.readouterr().out.strip() == __version__

    @pytest.mark.parametrize("verb", VERBS)
    def test_every_verb_has_help(self, verb: str, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as ended:
            main([verb, "--help"])
        assert ended.value.code == 0
        assert "usage: extrags" in capsys.readouterr().out


class TestUsage:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["phantom/0@spars"], "no setting 'spars'"),
            (["fantom/0@sparse"], "Did you mean phantom/0@sparse"),
            (["~rec.mp4"], "no such file or folder: "),
            (["@~list.txt"], "the manifest ~list.txt cannot be read: No such file or directory\n"),
            ([SEQUENCE, "--set", "coarse.iteration=1"], "did you mean coarse.iterations"),
            ([SEQUENCE, "--set", "coarse.iterations=-1"], "coarse.iterations"),
            ([SEQUENCE, "--set", "coarse.iterations"], "expected NAME=VALUE"),
            ([SEQUENCE, "--seed", "-1"], "the seed is -1"),
            ([SEQUENCE, "--seed", str(2**63)], f"the seed is {2**63}; expected 0 to {2**63 - 1}"),
            ([SEQUENCE, "--seeds", f"0,{2**64}"], f"--seeds {2**64}: expected 0 to"),
            ([SEQUENCE, "--coarse.seed", str(2**64)], "coarse.seed"),
            ([SEQUENCE, "--until", "finnish"], "invalid choice: 'finnish' (choose from 'ingest', 'poses'"),
            ([SEQUENCE, "--profile", "balancd"], "; did you mean balanced?"),
            (
                [],
                "the following arguments are required: SEQUENCE or --manifest FILE (see extrags run --help)",
            ),
            ([SEQUENCE, "--reruns", "2"], "unknown argument --reruns"),
            ([SEQUENCE, "--sed", "2"], "did you mean --seed"),
            ([SEQUENCE, "--coarse.iteration", "2"], "did you mean --coarse.iterations"),
            ([SEQUENCE, "--iterations=2"], "did you mean --coarse.iterations or --uc_nerf.iterations"),
            ([SEQUENCE, "--coarse.light", "no"], "--coarse.light is a group of settings; name one of"),
            ([SEQUENCE, "--coarse.iterations", "-1"], "is -1; expected a whole number of at least 1"),
            ([SEQUENCE, "--coarse.iterations", "1.5"], "is 1.5; expected a whole number of at least 1"),
            ([SEQUENCE, "--coarse.thickness=0"], "is 0; expected a number above 0 and at most 1"),
            ([SEQUENCE, "--enhance.backend", "clasical"], "is clasical; expected embedded, classical,"),
            ([SEQUENCE, "--coarse.light.enabled", "maybe"], "is maybe; expected true or false"),
            ([SEQUENCE, "--method", "3dgs", "--coarse.sh_degree", "1"], "sets coarse.sh_degree itself"),
            ([SEQUENCE, "--help-settings", "coarse.lite"], "no setting coarse.lite; did you mean coarse."),
            ([SEQUENCE, "--help-settings", "coarse.lght"], "did you mean coarse.light?"),
            ([SEQUENCE, "--seed", "1", "--seeds", "2"], "--seeds replaces --seed"),
            ([SEQUENCE, "--method", "coarse", "--methods", "3dgs"], "--methods replaces --method"),
            ([SEQUENCE, "--method", "extrags", "--methods", "3dgs"], "--methods replaces --method"),
            (
                [SEQUENCE, "--matrix", "coarse.iterations=5,6", "--coarse.iterations", "7"],
                "--matrix coarse.iterations replaces --coarse.iterations",
            ),
            ([SEQUENCE, "--store", ""], "argument --store: expected a folder or a URL"),
            ([SEQUENCE, "--at-once", "0"], "--at-once is 0"),
            ([SEQUENCE, SEQUENCE], "named twice"),
        ],
    )
    def test_wrong_usage_is_one_sentence_and_exit_code_2(
        self, arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["run", *arguments, "--store", str(tmp_path / "store")]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert "Traceback" not in said
        assert said.count("\n") == 1
        assert not (tmp_path / "store" / "artefacts").exists()

    @pytest.mark.parametrize(
        ("variable", "message"),
        [
            ("EXTRAGS_RUN_PAGE", "EXTRAGS_RUN_PAGE is 'maybe'; expected 0 or 1"),
            ("EXTRAGS_VERIFY", "EXTRAGS_VERIFY is 'maybe'; expected all or metadata"),
        ],
    )
    def test_wrong_values_in_the_environment(
        self,
        variable: str,
        message: str,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.setenv(variable, "maybe")
        assert main(["run", SEQUENCE, "--store", str(tmp_path / "store")]) == 2
        assert message in capsys.readouterr().err

    def test_debug_shows_where(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError):
            main(["run", SEQUENCE, "--seed", "-1", "--debug", "--store", str(tmp_path)])

    def test_a_store_that_cannot_be_written(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "file").write_text("x")
        assert main(["run", SEQUENCE, "--store", str(tmp_path / "file")]) == 1
        assert "cannot be written" in capsys.readouterr().err

    def test_settings_are_yaml(self) -> None:
        given = ["a.b=1", "a.c=0.5", "a.d=true", "a.e=[1, 2]", "a.f=null", "a.g=text", "a.h=1e-3"]
        parsed = parsed_settings(given)
        assert parsed["a.b"] == 1
        assert parsed["a.c"] == 0.5
        assert parsed["a.d"] is True
        assert parsed["a.e"] == [1, 2]
        assert parsed["a.f"] is None
        assert parsed["a.g"] == "text"
        assert parsed["a.h"] == 1e-3


def parsed(*arguments: str) -> dict[str, object]:
    return dict(parser("run").parse_args(["run", SEQUENCE, *arguments]).settings)


class TestSettings:
    """Every setting is a flag; the profile comes first, then whatever stands last on the command line."""

    @pytest.mark.parametrize("profile", PROFILES)
    def test_every_field_has_a_flag_that_takes_its_default(self, profile: str) -> None:
        def flags(model: object, prefix: str = "") -> Iterator[tuple[str, object]]:
            for name, value in model:  # type: ignore[attr-defined]
                if hasattr(type(value), "model_fields"):
                    yield from flags(value, f"{prefix}{name}.")
                else:
                    yield f"{prefix}{name}", value

        wanted = dict(flags(PROFILES[profile]))
        known = settings_of(PipelineConfig)
        given = parsed(*(f"--{name}={known[name].text(value)}" for name, value in wanted.items()))
        assert given == wanted
        assert PipelineConfig().with_overrides(given) == PROFILES[profile]

    def test_flags_and_set_come_after_profile_and_seed(self) -> None:
        arguments = ["--coarse.iterations", "7", "--profile", "quick", "--seed", "3", "--coarse.seed", "5"]
        given = parser("run").parse_args(["run", *arguments, "--set", "coarse.max_points=50", SEQUENCE])
        config = run_config(given)
        assert (config.coarse.iterations, config.coarse.max_points) == (7, 50)
        assert (config.coarse.seed, config.finetune.seed) == (5, 3)
        assert config.enhance == PROFILES["quick"].with_seed(3).enhance

    def test_the_scale_has_a_short_name(self) -> None:
        given = parser("run").parse_args(["run", SEQUENCE, "--scale", "12.5"])
        assert run_config(given).ingest.scale_mm_per_unit == 12.5
        with pytest.raises(ConfigError, match=r"scale_mm_per_unit.*above 0"):
            parser("run").parse_args(["run", SEQUENCE, "--scale", "0"])

    def test_the_last_one_counts(self) -> None:
        flag, assignment = ["--coarse.iterations", "7"], ["--set", "coarse.iterations=8"]
        assert parsed(*flag, *assignment) == {"coarse.iterations": 8}
        assert parsed(*assignment, *flag) == {"coarse.iterations": 7}
        assert parsed() == {}

    @pytest.mark.parametrize("verb", ["run", "plan", "report", "export", "evaluate", "benchmark"])
    def test_help_names_every_setting_by_group(self, verb: str, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit):
            main([verb, "--help"])
        listed = capsys.readouterr().out.partition("settings (")[2]
        for setting in settings_of(PipelineConfig).values():
            if not setting.group:
                assert f"  --{setting.name}\n" in listed
                continue
            _, _, behind = listed.partition(f"  --{setting.group}.*: ")
            assert setting.name.rpartition(".")[2] in behind.partition("--")[0].split()

    def test_a_method_without_a_plan_says_so(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["plan", SEQUENCE, "--method", "coarse"]) == 2
        assert "no stage of the method coarse depends on a plan" in capsys.readouterr().err

    @pytest.mark.parametrize("arguments", [["run"], ["export"], ["bench", "enhance"]])
    def test_settings_are_explained_with_the_defaults_of_the_profile(
        self, arguments: list[str], capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main([*arguments, "--help-settings", "--profile", "paper"]) == 0
        said = " ".join(capsys.readouterr().out.split())
        for setting in settings_of(PipelineConfig).values():
            assert f"--{setting.name} " in said
            assert f"{setting.description} ({setting.expected})" in said
        assert "--coarse.iterations 30000 optimisation steps" in said
        assert "--enhance.channels 48,96,160 " in said
        assert "--ingest.width none " in said

    def test_one_group_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["run", "--help-settings", "coarse.light"]) == 0
        said = capsys.readouterr().out
        assert "--coarse.light.exponent 0.6" in said
        assert "--coarse.iterations" not in said

    def test_reading_data_takes_the_settings_of_ingest_alone(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["data", "show", SEQUENCE, "--ingest.width", "48", "--json", "-"]) == 0
        assert json.loads(capsys.readouterr().out)["measured"]["width"] == 48
        assert main(["data", "show", SEQUENCE, "--coarse.iterations", "4"]) == 2
        assert "unknown argument --coarse.iterations" in capsys.readouterr().err


class TestFailures:
    """What is said of an exception: one line each, a hint where there is one, no traceback."""

    @pytest.fixture
    def fail(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
        def failing(error: Exception, *more: str) -> tuple[int, list[str]]:
            def execute(*_: object, **__: object) -> None:
                raise error

            monkeypatch.setattr("flows.commands.run.execute", execute)
            code = main(["run", SEQUENCE, *more])
            return code, capsys.readouterr().err.splitlines()

        return failing

    def test_an_expected_one_is_its_sentence_and_its_note(self, fail) -> None:
        error = MissingDependencyError("diffusers is not installed")
        error.add_note("pip install 'extrags[diffusers]'")
        assert fail(error) == (
            1,
            ["extrags: diffusers is not installed", "extrags: pip install 'extrags[diffusers]'"],
        )

    def test_an_expected_one_behind_another(self, fail) -> None:
        error = RuntimeError("Task run failed")
        error.__cause__ = ConfigError("the crop is 33; expected a multiple of 8")
        assert fail(error) == (1, ["extrags: the crop is 33; expected a multiple of 8"])

    @pytest.mark.parametrize(
        "error",
        [ConnectionRefusedError(111, "Connection refused"), httpx.ConnectError("All attempts failed")],
    )
    def test_a_server_that_went_away(self, error: Exception, fail, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:4200/api")
        code, (said, hint) = fail(error)
        assert code == 1
        assert said == f"extrags: a server went away or was never there: {type(error).__name__}: {error}"
        assert "http://127.0.0.1:4200/api" in hint
        assert hint.endswith("run again: what is finished stays in the store")

    def test_an_unexpected_one_is_one_line_and_where_to_find_more(self, fail) -> None:
        code, said = fail(ZeroDivisionError("division\nby zero"))
        assert code == 1
        assert said == [
            "extrags: ZeroDivisionError: division by zero",
            "extrags: run again with --debug for the traceback",
        ]

    def test_debug_shows_where(self, fail) -> None:
        with pytest.raises(ZeroDivisionError):
            fail(ZeroDivisionError(), "--debug")

    @pytest.mark.parametrize(
        "arguments",
        [["--debug", "cache", "ls"], ["cache", "--debug", "ls"], ["cache", "ls", "--debug"]],
    )
    def test_debug_may_stand_behind_any_verb(
        self, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def looked_into(given: argparse.Namespace) -> None:
            assert given.debug
            raise ZeroDivisionError

        monkeypatch.setattr("flows.commands.cache._looked_into", looked_into)
        with pytest.raises(ZeroDivisionError):
            main([*arguments, "--store", str(tmp_path)])


class TestData:
    def test_show(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "show", SEQUENCE, "--ingest.max_frames", "4", "--json", "-"]) == 0
        assert json.loads(capsys.readouterr().out)["has_depth"] is True

    def test_show_unknown(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["data", "show", "nowhere"]) == 2
        assert "nowhere" in capsys.readouterr().err


@pytest.mark.usefixtures("prefect_server")
class TestThroughPrefect:
    def test_run_starts_a_flow(self, finished: tuple[str, SequenceOutcome], tmp_path: Path) -> None:
        store, first = finished
        target = tmp_path / "results.json"
        arguments = ["run", SEQUENCE, *settled(store), "--always-flow", "--json", str(target)]
        assert main(arguments) == 0
        found = json.loads(target.read_text())
        assert not undocumented(found, "run")
        (sequence,) = found["sequences"]
        assert {stage["state"] for stage in sequence["stages"]} == {"cached", "skipped"}
        assert sequence["digests"] == first.digests

    def test_a_failed_sequence_is_exit_code_1(
        self,
        finished: tuple[str, SequenceOutcome],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        store, _ = finished
        (tmp_path / "empty").mkdir()
        target = tmp_path / "results.json"
        folder = str(tmp_path / "empty")
        assert main(["run", folder, SEQUENCE, *settled(store), "--json", str(target)]) == 1
        found = json.loads(target.read_text())
        assert not undocumented(found, "run")
        first, second = found["sequences"]
        assert (first["status"], second["status"]) == ("failed", "ok")
        # The table wraps where columns are narrow.
        assert "the folder is empty" in first["stages"][0]["reason"]
        assert "folder" in capsys.readouterr().err
        # Quiet or not, a failure is one sentence.
        assert main(["-q", "run", folder, *settled(store)]) == 1
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1
        assert "failed in ingest: " in said[0]
        assert "the folder is empty" in said[0]

    def test_a_single_wrong_source_needs_no_flow(
        self,
        finished: tuple[str, SequenceOutcome],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        def started(**_: object) -> None:
            pytest.fail("a flow was started")

        monkeypatch.setattr("flows.dataset.reconstruct_dataset", started)
        store, _ = finished
        (tmp_path / "exam.mp4").write_text("hello")
        target = tmp_path / "results.json"
        assert main(["run", str(tmp_path / "exam.mp4"), *settled(store), "--json", str(target)]) == 1
        (found,) = json.loads(target.read_text())["sequences"]
        assert "cannot be opened as a video" in found["stages"][0]["reason"]
        assert {row["state"] for row in found["stages"][1:]} == {"skipped"}
        assert capsys.readouterr().err.count("cannot be opened as a video") == 1
        # It is on record as any run that failed.
        assert main(["status", "--store", store, "--json", "-"]) == 1
        assert "cannot be opened as a video" in capsys.readouterr().out
