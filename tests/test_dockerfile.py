"""The image without a daemon: its file is read and held against the project, its steps are run by a shell."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
import yaml
from prefect.utilities.templating import apply_values

REPOSITORY = Path(__file__).resolve().parents[1]
DOCKERFILE = REPOSITORY / "deploy" / "Dockerfile"
KNOWN = {"FROM", "RUN", "COPY", "ENV", "WORKDIR", "USER", "VOLUME", "ENTRYPOINT", "CMD"}


@dataclass
class Stage:
    """From one FROM to the next."""

    image: str
    name: str
    steps: list[tuple[str, str]] = field(default_factory=list)

    def of(self, instruction: str) -> list[str]:
        return [text for kind, text in self.steps if kind == instruction]


def stages() -> list[Stage]:
    text = re.sub(r"^#.*\n", "", DOCKERFILE.read_text(), flags=re.MULTILINE)
    found: list[Stage] = []
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        if not line.strip():
            continue
        instruction, _, rest = line.partition(" ")
        assert instruction in KNOWN, line
        if instruction == "FROM":
            image, _, name = rest.partition(" AS ")
            found.append(Stage(image, name))
        else:
            found[-1].steps.append((instruction, rest.strip()))
    return found


def tracked() -> list[str]:
    done = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def copied(stage: Stage) -> list[str]:
    """What a stage takes from the build context."""
    words = [shlex.split(text) for text in stage.of("COPY") if not text.startswith("--from")]
    return [source for line in words for source in line[:-1]]


def environment(stage: Stage) -> dict[str, str]:
    pairs = [word.partition("=") for text in stage.of("ENV") for word in shlex.split(text)]
    return {name: value for name, _, value in pairs}


class TestFile:
    def test_two_stages_of_one_named_release(self) -> None:
        build, final = stages()
        assert build.name == "build"
        assert build.image == final.image == "python:3.11-slim-bookworm"
        assert any(text.startswith("--from=build ") for text in final.of("COPY"))
        assert not any("g++" in text or "pip" in text for text in final.of("RUN"))

    def test_it_does_not_run_as_root(self) -> None:
        _, final = stages()
        (user,) = final.of("USER")
        assert int(user) > 0, "by number: Kubernetes cannot see that a name is not root"
        order = [kind for kind, _ in final.steps]
        assert order.index("USER") > max(place for place, kind in enumerate(order) if kind in ("RUN", "COPY"))
        assert f"--uid {user}" in " ".join(final.of("RUN"))

    def test_what_it_copies_is_in_the_project_and_in_the_context(self) -> None:
        build, _ = stages()
        files = tracked()
        ignore = [
            line for line in (REPOSITORY / ".dockerignore").read_text().split() if not line.startswith("#")
        ]
        kept = {line[1:] for line in ignore if line.startswith("!")}
        for source in copied(build):
            assert source in files or any(name.startswith(f"{source}/") for name in files), source
            assert source in kept, f"{source} is not in the build context"
        assert kept == set(copied(build))

    def test_the_wheel_has_all_it_is_built_from(self) -> None:
        build, _ = stages()
        project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
        packages = project["tool"]["scikit-build"]["wheel"]["packages"]
        named = [*packages, project["project"]["readme"], *project["project"]["license-files"]]
        assert {*named, "pyproject.toml", "CMakeLists.txt", "requirements.lock"} <= set(copied(build))

    def test_versions_are_those_of_the_lock(self) -> None:
        build, _ = stages()
        pip = [text for text in build.of("RUN") if "pip install" in text]
        assert pip == [
            "pip install --requirement requirements.lock",
            "pip install --no-deps --no-build-isolation .",
        ]
        # The locks before the sources: a change of the latter does not install everything anew.
        steps = [text for kind, text in build.steps if kind in ("RUN", "COPY")]
        assert steps.index(pip[0]) < steps.index("COPY extrags extrags".partition(" ")[2])

    def test_system_packages_leave_no_lists(self) -> None:
        for stage in stages():
            for text in stage.of("RUN"):
                if "apt-get install" in text:
                    assert "--yes --no-install-recommends" in text
                    assert "rm -rf /var/lib/apt/lists/*" in text
                    assert text.startswith("apt-get update")

    def test_store_and_data_are_where_the_environment_says(self) -> None:
        _, final = stages()
        given = environment(final)
        volumes = json.loads(final.of("VOLUME")[0])
        assert given["EXTRAGS_STORE"] in volumes
        assert given["EXTRAGS_CACHE"] in volumes
        made = " ".join(final.of("RUN"))
        for name in ("EXTRAGS_STORE", "EXTRAGS_DATA", "EXTRAGS_CACHE"):
            assert re.search(rf"--owner=extrags .*{given[name]}\b", made), name
        assert given["OMP_WAIT_POLICY"] == "passive"

    def test_no_secrets(self) -> None:
        assert not re.search(r"(?i)password|token|secret|_key\b", DOCKERFILE.read_text())


def pod_of_the_kubernetes_pool(**job_variables: Any) -> dict[str, Any]:
    """What a run of the pool is, as Prefect fills in the template."""
    template = json.loads((REPOSITORY / "deploy" / "kubernetes-job-template.json").read_text())
    properties = template["variables"]["properties"]
    defaults = {name: about["default"] for name, about in properties.items() if "default" in about}
    job = apply_values(template["job_configuration"]["job_manifest"], {**defaults, **job_variables})
    pod: dict[str, Any] = job["spec"]["template"]["spec"]
    return pod


def test_the_template_of_the_kubernetes_pool() -> None:
    template = json.loads((REPOSITORY / "deploy" / "kubernetes-job-template.json").read_text())
    variables = template["variables"]["properties"]
    used = set(re.findall(r"\{\{ (\w+) \}\}", json.dumps(template["job_configuration"])))
    assert used == set(variables)
    spec = pod_of_the_kubernetes_pool()
    (container,) = spec["containers"]
    assert {item["name"] for item in container["volumeMounts"]} == {item["name"] for item in spec["volumes"]}
    _, final = stages()
    assert str(spec["securityContext"]["runAsUser"]) == final.of("USER")[0]
    assert {item["mountPath"] for item in container["volumeMounts"]} >= set(json.loads(final.of("VOLUME")[0]))
    assert {"name": "store", "persistentVolumeClaim": {"claimName": "extrags-store"}} in spec["volumes"]


def test_a_kubernetes_run_with_an_object_store_needs_no_claim_for_it() -> None:
    told = (REPOSITORY / "docs" / "deployments.md").read_text()
    (line,) = [line for line in told.splitlines() if '"emptyDir"' in line]
    given = json.loads(line)
    spec = pod_of_the_kubernetes_pool(**given)
    (container,) = spec["containers"]
    assert {"name": "EXTRAGS_STORE", "value": given["store"]} in container["env"]
    assert "://" in given["store"]
    claims = [item["persistentVolumeClaim"] for item in spec["volumes"] if "persistentVolumeClaim" in item]
    assert [claim["claimName"] for claim in claims] == ["extrags-data"]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_steps_of_the_build(tmp_path: Path) -> None:
    """Every step of the build stage in its order, by a shell; system packages alone are taken for granted.

    The packages of the lock are those of this environment, which pip finds to be what it wants.
    """
    build, _ = stages()
    shell = shutil.which("sh")
    assert shell is not None
    context, source, prefix = tmp_path / "context", tmp_path / "src", tmp_path / "opt"
    for name in tracked():
        if not any(fnmatchcase(name, pattern) for pattern in ("*.so", "*__pycache__*")):
            (context / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(REPOSITORY / name, context / name)
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, line in (("apt-get", "exit 0"), ("python", f'exec {sys.executable} "$@"')):
        (tools / name).write_text(f"#!{shell}\n{line}\n")
        (tools / name).chmod(0o755)
    variables = {**os.environ, "PATH": f"{tools}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    # Nothing is fetched: what pip does not find here fails.
    variables["PIP_NO_INDEX"] = "1"
    variables.pop("PYTHONPATH", None)

    def here(text: str) -> str:
        return text.replace("/opt/extrags", str(prefix)).replace("/var/lib/apt", str(tmp_path / "apt"))

    source.mkdir()
    for kind, text in build.steps:
        if kind == "ENV":
            for word in shlex.split(here(text)):
                name, _, value = word.partition("=")
                variables[name] = value.replace("$PATH", variables["PATH"])
        elif kind == "COPY":
            *names, target = shlex.split(text)
            for name in names:
                place = source / target / name if target.endswith("/") else source / target
                copy: Any = shutil.copytree if (context / name).is_dir() else shutil.copyfile
                copy(context / name, place)
        elif kind == "RUN":
            done = subprocess.run(
                [shell, "-ec", here(text)],
                cwd=source,
                env=variables,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            assert done.returncode == 0, f"{text}\n{done.stdout[-4000:]}"
            if "venv" in text:
                _lend_packages(prefix, tmp_path / "lent")

    def said(*command: str) -> str:
        return subprocess.run(
            command, cwd=tmp_path, env=variables, capture_output=True, text=True, check=False
        ).stderr

    packages = Path(said_out(prefix, variables, tmp_path, "import flows; print(flows.__path__[0])"))
    assert packages.is_relative_to(prefix)
    assert said_out(
        prefix, variables, tmp_path, "from extrags.raster import native; print(native.native_isa())"
    ) in ("avx512", "avx2", "portable")
    # The deployments come with the wheel.
    names = [
        item["name"] for item in yaml.safe_load((REPOSITORY / "prefect.yaml").read_text())["deployments"]
    ]
    known = said(str(prefix / "bin" / "extrags"), "serve", "none").rpartition("known: ")[2]
    assert [name.partition("/")[2] for name in known.strip().split(", ")] == names


def _lend_packages(prefix: Path, lent: Path) -> None:
    """The packages of this environment, without extrags, for the new one."""
    lent.mkdir()
    own = re.compile(r"(extrags|flows|tasks|data_catalog|_extrags|__editable__)", re.IGNORECASE)
    for entry in Path(sysconfig.get_paths()["purelib"]).iterdir():
        if not own.match(entry.name) and entry.suffix != ".pth":
            (lent / entry.name).symlink_to(entry)
    (packages,) = (prefix / "lib").glob("python3*/site-packages")
    # A new environment brings an old one, which would hide what torch asks for.
    hiding = ("setuptools*", "pkg_resources", "_distutils_hack", "distutils-precedence.pth")
    for entry in [entry for pattern in hiding for entry in packages.glob(pattern)]:
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    (packages / "lent.pth").write_text(f"{lent}\n")


def said_out(prefix: Path, variables: dict[str, str], folder: Path, code: str) -> str:
    done = subprocess.run(
        [str(prefix / "bin" / "python"), "-c", code],
        cwd=folder,
        env=variables,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()
