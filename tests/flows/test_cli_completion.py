"""Completion in shells: what the printed scripts answer, as the shells ask them."""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from extrags.config import PROFILES, PipelineConfig
from extrags.config.settings import settings_of
from flows.cli import VERBS, main
from flows.commands.completion import table
from flows.methods import METHODS

ASK = """
source "$1"
COMP_LINE="$2" COMP_POINT=${#2}
_extrags
printf '%s\\n' "${COMPREPLY[@]}"
"""
"""readline's own call of the function that `complete -F` names."""


def printed(shell: str, folder: Path) -> Path:
    made = folder / f"extrags.{shell}"
    said = StringIO()
    with redirect_stdout(said):
        assert main(["completion", shell]) == 0
    made.write_text(said.getvalue(), encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return printed("bash", tmp_path_factory.mktemp("completion"))


@pytest.fixture
def ask(script: Path, tmp_path: Path):
    """What readline would put behind its last word break, given a line that ends where the cursor is."""

    def asked(line: str) -> list[str]:
        command = ["bash", "--norc", "-c", ASK, "bash", str(script), line]
        # Nothing but a shell and awk: no Python is on the way.
        environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
        said = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        assert said.stderr == ""
        return [line for line in said.stdout.splitlines() if line]

    return asked


class TestBash:
    def test_verbs(self, ask) -> None:
        assert ask("extrags ") == list(VERBS)
        assert ask("extrags be") == ["benchmark", "bench"]
        assert ask("extrags -q --debug pla") == ["plan"]
        assert ask("extrags data ") == ["list", "show", "check"]
        assert ask("extrags bench st") == ["stability"]
        assert ask("extrags nothing ") == []

    def test_options(self, ask) -> None:
        assert ask("extrags --ver") == ["--version"]
        assert ask("extrags run phantom/0 --st") == ["--store", "--stage-time-limit"]
        assert ask("extrags cache gc --older") == ["--older-than"]
        assert ask("extrags data list --h") == ["--help", "--here"]

    def test_settings_part_by_part(self, ask) -> None:
        assert ask("extrags run --coarse.iter") == ["--coarse.iterations"]
        assert ask("extrags run --coar") == ["--coarse."]
        assert {"--coarse.light.", "--coarse.seed"} <= set(ask("extrags run --coarse."))
        assert ask("extrags data check --coarse.") == []
        assert "--ingest.max_frames" in ask("extrags data check --ingest.")
        assert ask("extrags status --coarse.") == []

    def test_every_setting_can_be_reached(self, ask) -> None:
        for name in list(settings_of(PipelineConfig))[::20]:
            assert f"--{name}" in ask(f"extrags run --{name}")
            assert f"{name}=" in ask(f"extrags run --set {name}")

    def test_values(self, ask) -> None:
        assert ask("extrags run --profile ") == list(PROFILES)
        assert ask("extrags run --method ex") == ["extrags", "exploregs"]
        assert ask("extrags plan --enhance.backend cl") == ["classical"]
        assert ask("extrags run --coarse.light.enabled ") == ["true", "false"]
        assert ask("extrags export phantom/0 --to sp") == ["spz"]
        assert ask("extrags run --runner d") == ["dask"]
        assert ask("extrags run --seed ") == []
        assert ask("extrags export a --along h") == ["held-out"]

    def test_behind_an_equals_sign_only_what_follows_is_replaced(self, ask) -> None:
        assert ask("extrags run --profile=q") == ["quick"]
        assert ask("extrags run --set enhance.backend=cl") == ["classical"]
        assert ask("extrags run --set=enhance.back") == ["enhance.backend="]
        assert ask("extrags run --matrix enhance.backend=classical,emb") == ["classical,embedded"]

    def test_several_values(self, ask) -> None:
        assert ask("extrags run a --methods 3dgs ex") == ["extrags", "exploregs"]
        assert ask("extrags run a --methods 3dgs,co") == ["3dgs,coarse"]
        assert set(ask("extrags run a --methods ")) == set(METHODS)
        assert ask("extrags run a --methods 3dgs --unt") == ["--until"]

    def test_sequences(self, ask) -> None:
        assert "phantom/" in ask("extrags run ")
        assert {"phantom/0@sparse", "phantom/0@distanced"} <= set(ask("extrags run phantom/"))
        # readline breaks words at @, and replaces it as well.
        assert ask("extrags run phantom/0@sp") == ["@sparse"]
        assert "sinus/hopkins" in ask("extrags data check --ingest.width 48 sinus/")
        assert "phantom/0@sparse" in ask("extrags compare phantom/0")

    def test_files(self, ask, tmp_path: Path) -> None:
        (tmp_path / "my_frames").mkdir()
        (tmp_path / "my.yaml").write_text("")
        assert set(ask("extrags run my")) == {"my_frames/", "my.yaml"}
        assert set(ask("extrags run --config my")) == {"my_frames/", "my.yaml"}
        assert ask("extrags run --config=my.") == ["my.yaml"]
        assert ask("extrags run --json my.") == ["my.yaml"]
        assert ask("extrags run --depth.completion my.") == ["my.yaml"]

    def test_names_of_files_are_quoted_as_the_word_is(self, ask, tmp_path: Path) -> None:
        (tmp_path / "my frames").mkdir()
        (tmp_path / "my frames" / "it's $1").mkdir()
        assert ask("extrags run my") == [r"my\ frames/"]
        assert ask(r"extrags run my\ fr") == [r"my\ frames/"]
        assert ask("extrags run my\\") == [r"my\ frames/"]
        assert ask(r"extrags run my\ frames/it") == [r"my\ frames/it\'s\ \$1/"]
        # The quote itself is before what readline replaces.
        assert ask('extrags run "my frames/i') == [r"my frames/it's \$1/"]
        assert ask("extrags run 'my fr") == ["my frames/"]
        assert ask("extrags run 'my frames/i") == [r"my frames/it'\''s $1/"]
        assert ask('extrags run "my frames"/i') == [r""""my frames"/it\'s\ \$1/"""]
        assert ask("extrags run --config=my") == [r"my\ frames/"]
        assert ask('extrags run --config="my f') == ["my frames/"]

    def test_quoted_words_are_one(self, ask) -> None:
        assert ask(r"extrags run --store my\ store --profile q") == ["quick"]
        assert ask("extrags run --store 'my store' --profile q") == ["quick"]
        assert ask("extrags run --methods '--until' ex") == ask("extrags run --methods --until ex")
        assert ask('extrags run "phantom/0@sp') == ["phantom/0@sparse"]
        assert ask(r"extrags run phantom/0\@sp") == [r"phantom/0\@sparse"]

    def test_home(self, ask, tmp_path: Path) -> None:
        (tmp_path / ".cache" / "my frames").mkdir(parents=True)
        (tmp_path / ".case").write_text("")
        assert set(ask("extrags run ~/.ca")) == {"~/.cache/", "~/.case"}
        assert ask("extrags run --config=~/.cac") == ["~/.cache/"]
        assert ask("extrags run ~/.cache/") == [r"~/.cache/my\ frames/"]
        # No user is called so.
        (tmp_path / "~;x y").mkdir()
        assert ask("extrags run '~;") == ["~;x y/"]

    def test_shells(self, ask) -> None:
        assert ask("extrags completion ") == ["bash", "zsh", "fish"]

    def test_other_settings_of_a_training_are_not_offered(self, ask) -> None:
        assert ask("extrags pretrain --set coarse.") == []
        assert ask("extrags pretrain --coarse.") == []


class TestBashAtATerminal:
    """What the command gets, where readline itself puts proposals into the line."""

    @pytest.mark.parametrize(
        ("typed", "got"),
        [
            ("my\ta\t", ["my frames/a.yaml"]),
            ("my\\ f\ta\t", ["my frames/a.yaml"]),
            ('"my\ta\t', ["my frames/a.yaml"]),
            ("'my f\ta\t", ["my frames/a.yaml"]),
            ("--config=my\ta\t", ["--config=my frames/a.yaml"]),
            ('--config="my f\ta\t', ["--config=my frames/a.yaml"]),
            ('"my frames"/a\t', ["my frames/a.yaml"]),
            ("~/.ca\tb\t", ["{home}/.cache/b"]),
            ("--config=~/.ca\tb\t", ["--config=~/.cache/b"]),
            ("phantom/0@sp\t", ["phantom/0@sparse"]),
            ("'phantom/0@sp\t", ["phantom/0@sparse"]),
            ("a@f\t", ["a@file"]),
            (
                "--profile=q\t--set enhance.backend=cl\t",
                ["--profile=quick", "--set", "enhance.backend=classical"],
            ),
            ("it\t", ["it's $1"]),
            ('"it\t', ["it's $1"]),
            ("'it\t", ["it's $1"]),
        ],
    )
    def test_words(self, typed: str, got: list[str], script: Path, tmp_path: Path) -> None:
        (tmp_path / "my frames").mkdir()
        (tmp_path / "my frames" / "a.yaml").write_text("")
        (tmp_path / ".cache").mkdir()
        (tmp_path / ".cache" / "b").write_text("")
        (tmp_path / "it's $1").write_text("")
        (tmp_path / "a@file").write_text("")
        (tmp_path / "start").write_text(
            f"source {script}\n"
            # Its words into a file: the terminal shows them too, but among what readline draws.
            """extrags() { printf '%s\\0' "${@:2}" > said; exit; }\n"""
            "PS1='ready> '\n"
        )
        command = ["bash", "--rcfile", "start", "-i"]
        environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "TERM": "dumb", "INPUTRC": "/dev/null"}
        terminal, inside = pty.openpty()
        with subprocess.Popen(
            command, cwd=tmp_path, env=environment, stdin=inside, stdout=inside, stderr=inside,
            start_new_session=True,
        ) as shell:  # fmt: skip
            os.close(inside)
            seen = b""
            try:
                while b"ready> " not in seen:
                    seen += os.read(terminal, 4096)
                os.write(terminal, f"extrags run {typed}\n".encode())
                shell.wait(30)
            finally:
                shell.kill()
                os.close(terminal)
        words = (tmp_path / "said").read_text().split("\0")[:-1]
        assert words == [word.format(home=tmp_path) for word in got]


class TestTable:
    def test_every_row_has_its_fields(self) -> None:
        fields = {"C": 2, "O": 5, "P": 3, "S": 3, "T": 3, "Q": 2}
        rows = [row.split("\t") for row in table()]
        assert {row[0]: len(row) for row in rows} == fields
        assert all(len(row) == fields[row[0]] for row in rows)
        assert {row[1] for row in rows if row[0] == "C"} >= {*VERBS, "data check", "bench pipeline"}
        assert {row[1] for row in rows if row[0] == "T"} == set(settings_of(PipelineConfig))

    def test_it_can_be_quoted(self) -> None:
        assert not [row for row in table() if "'" in row or "\\" in row]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
class TestOtherShells:
    """Their functions hand words to the same program; what differs is how."""

    def test_the_program_answers(self, shell: str, tmp_path: Path) -> None:
        if shutil.which(shell) is None:
            pytest.skip(f"no {shell} here")
        made = printed(shell, tmp_path)
        load = {"zsh": "compdef() { :; }; source", "fish": "source"}[shell]
        name = {"zsh": "_extrags_completions", "fish": "__extrags_completions"}[shell]
        for words, expected in (
            ("extrags run --coarse.iter", "--coarse.iterations"),
            ("extrags run phantom/0@sp", "phantom/0@sparse"),
            ("extrags run --profile=q", "--profile=quick"),
            ("extrags data che", "check"),
        ):
            code = f"{load} {made}; {name} {words}"
            said = subprocess.run([shell, "-c", code], capture_output=True, text=True, check=True)
            assert (said.stdout.split(), said.stderr) == ([expected], "")


@pytest.mark.skipif(shutil.which("fish") is None, reason="no fish here")
def test_fish_completes(tmp_path: Path) -> None:
    """The one shell that can be asked without a terminal."""
    made = printed("fish", tmp_path)
    (tmp_path / "my.yaml").write_text("")
    for line, expected in (
        ("extrags run --coarse.iter", ["--coarse.iterations"]),
        ("extrags run --config m", ["my.yaml"]),
        ("extrags run --config=m", ["--config=my.yaml"]),
        ("extrags comp", ["compare", "completion"]),
    ):
        code = f"source {made}; complete -C '{line}'"
        said = subprocess.run(["fish", "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
        assert sorted(said.stdout.split()) == expected
