"""The check that an interpreter runs on itself, before and after an environment is made."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from qgis_plugin import check_python
from qgis_plugin.layout import REQUIREMENTS, ROOT

SCRIPT = ROOT / "qgis_plugin" / "check_python.py"


@pytest.fixture
def site(tmp_path):
    """Return a function that puts a library of some version where Python looks for libraries."""

    def add(name, version):
        folder = tmp_path / "site" / f"{name.replace('-', '_')}-{version}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")

    return add


@pytest.fixture
def check(tmp_path):
    """Return a function that runs the check as a program of its own; exit code and lines."""

    def run(*requirements):
        file = tmp_path / "requirements.txt"
        file.write_text("\n".join(requirements) + "\n")
        environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
        done = subprocess.run(
            [sys.executable, str(SCRIPT), *([str(file)] if requirements else [])],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.stderr == ""
        return done.returncode, done.stdout.splitlines()

    return run


class TestLibraries:
    def test_that_are_there_are_listed_with_their_versions(self, check, site):
        site("one-thing", "2.0")
        site("other", "1.5.1")
        code, lines = check("one-thing>=1.26", "other>=1.5")
        assert code == 0
        assert lines[1:] == ["one-thing 2.0", "other 1.5.1"]
        assert lines[0] == f"Python {sys.version.split()[0]}"

    def test_that_are_missing_or_too_old_are_all_named_in_the_last_line(self, check, site):
        site("old", "1.25.9")
        code, lines = check("gone>=1", "old>=1.26", "lost>=3")
        assert code == 1
        assert lines[-1] == "gone is missing, old 1.25.9 is older than 1.26, lost is missing"

    @pytest.mark.parametrize(
        ("version", "oldest", "enough"),
        [
            ("2.1.0rc1", "2.1", True),
            ("2.1.0rc1", "2.1.0", True),
            ("2.0.9.dev0+g12ab", "2.1", False),
            ("2.10", "2.9", True),
            ("2.9", "2.10", False),
            ("10.0", "9.9", True),
            ("2024.1", "2023.12", True),
            ("2.1+cu12.4", "2.1", True),
            ("2", "2.0", True),
            ("3", "2.1", True),
        ],
    )
    def test_are_compared_by_the_numbers_of_their_versions(self, check, site, version, oldest, enough):
        site("thing", version)
        assert check(f"thing>={oldest}")[0] == (0 if enough else 1)

    def test_without_a_lowest_version_need_only_be_there(self, check, site):
        site("thing", "0.0.1")
        assert check("thing")[0] == 0

    def test_of_the_plugin_are_all_in_the_core_s_environment(self, interpreter):
        done = subprocess.run(
            [interpreter, str(SCRIPT), str(REQUIREMENTS)], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")
        named = {line.split(">=")[0] for line in REQUIREMENTS.read_text().split()}
        assert {line.split()[0] for line in done.stdout.splitlines()} == {"Python", *named}


class TestInterpreter:
    def test_that_can_make_environments_is_fine(self, check):
        code, lines = check()
        assert (code, lines) == (0, [f"Python {sys.version.split()[0]}"])

    def test_that_is_too_old_is_told_with_both_versions(self, monkeypatch, capsys):
        monkeypatch.setattr(sys, "version_info", (3, 9, 18, "final", 0))
        assert check_python.main([]) == 1
        assert capsys.readouterr().out.splitlines()[-1] == "it is Python 3.9.18, and PolyMerge needs 3.10 or newer"

    @pytest.mark.parametrize("part", ["venv", "ensurepip"])
    def test_without_venv_or_ensurepip_names_debian_s_package(self, monkeypatch, capsys, part):
        find = check_python.importlib.util.find_spec
        monkeypatch.setattr(check_python.importlib.util, "find_spec", lambda name: None if name == part else find(name))
        assert check_python.main([]) == 1
        assert "python3-venv" in capsys.readouterr().out.splitlines()[-1]

    def test_needs_no_venv_to_hold_libraries(self, monkeypatch, tmp_path):
        monkeypatch.setattr(check_python.importlib.util, "find_spec", lambda _name: None)
        (tmp_path / "none.txt").touch()
        assert check_python.main([str(tmp_path / "none.txt")]) == 0
