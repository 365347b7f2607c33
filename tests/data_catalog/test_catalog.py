from __future__ import annotations

import errno
import json
import os
import pickle
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import data_catalog.folders
import extrags
from data_catalog.catalog import (
    describe,
    glance,
    list_sequences,
    measured_detail,
    read,
    resolve,
    source_fingerprint,
)
from data_catalog.dataset import Source
from data_catalog.folder_reader import FolderReader
from data_catalog.phantom.dataset import PHANTOM
from data_catalog.readers.posed_folder import READER as posed_folder_reader
from extrags.config import IngestConfig
from extrags.errors import ConfigError, SourceError, SourceNotFoundError, UnknownSequenceError


class TestNames:
    def test_every_listed_name_is_described_and_phantoms_resolve(self) -> None:
        listed = list_sequences()
        assert len({descriptor.name for descriptor in listed}) == len(listed)
        for descriptor in listed:
            assert describe(descriptor.name) == descriptor
            if descriptor.format == "phantom":
                assert resolve(descriptor.name).name == descriptor.name

    def test_phantom_beyond_the_list(self) -> None:
        source = resolve("phantom/1234@distanced")
        assert (source.name, source.dataset, source.paths) == ("phantom/1234@distanced", "phantom", ())
        assert describe("phantom/1234@distanced").frames == 48

    def test_setting_defaults_to_sparse(self) -> None:
        assert resolve("phantom/3") == resolve("phantom/3@sparse")

    @pytest.mark.parametrize(
        ("wrong", "near"), [("phantm/1@sparse", "phantom/1@sparse"), ("sinus_hopkin", "sinus_hopkins")]
    )
    def test_unknown_names_suggest_the_nearest(self, wrong, near) -> None:
        with pytest.raises(UnknownSequenceError, match=f"Did you mean {near}"):
            resolve(wrong)
        with pytest.raises(UnknownSequenceError, match=f"Did you mean {near}"):
            describe(wrong)

    def test_a_url_is_refused_without_its_password(self) -> None:
        with pytest.raises(UnknownSequenceError, match=r"^https://\*\*\*@host/video\.mp4 is a URL; "):
            describe("https://user:never-to-be-seen@host/video.mp4")

    @pytest.mark.parametrize("name", ["exam.mp4", "./exam", "/nowhere/exam", "scan.dcm"])
    def test_a_path_that_is_none_is_said_to_be_none(self, name) -> None:
        with pytest.raises(UnknownSequenceError, match=r"^no such file or folder: /"):
            describe(name)

    def test_a_path_is_no_name(self, posed_folder) -> None:
        with pytest.raises(UnknownSequenceError, match="is a file or folder, and no name of the catalogue"):
            describe(str(posed_folder))

    def test_unknown_setting_names_the_known_ones(self) -> None:
        with pytest.raises(UnknownSequenceError, match="'spars'; known: sparse, distanced"):
            resolve("phantom/3@spars")

    def test_known_set_without_its_files(self, tmp_path, monkeypatch) -> None:
        monkeypatch.setattr("data_catalog.named_folders.data_roots", lambda: [tmp_path])
        assert not describe("sinus/hopkins").available
        with pytest.raises(SourceNotFoundError, match="EXTRAGS_DATA"):
            resolve("sinus/hopkins")

    def test_data_root_from_the_environment(self, shared_data, tmp_path, monkeypatch) -> None:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("EXTRAGS_DATA", str(shared_data))
        assert resolve("simcol3d/s1").path == str(shared_data / "simcol3d_s1")

    def test_file_instead_of_folder(self, tmp_path) -> None:
        file = tmp_path / "notes.txt"
        file.write_bytes(b"0")
        with pytest.raises(SourceError, match=r"expected a folder .* a video \(\.mp4.* or a DICOM file"):
            resolve(file)


class TestFolders:
    def test_formats_are_recognised_by_content(self, shared_data, posed_folder) -> None:
        assert resolve(shared_data / "sinus_hopkins").name == "sinus/hopkins"
        assert resolve(shared_data / "simcol3d_s1").format == "simcol3d"
        assert resolve(shared_data / "sinus_hopkins" / "images").format == "frames"
        assert resolve(posed_folder).format == "extrags"

    def test_empty_folder(self, tmp_path) -> None:
        with pytest.raises(SourceNotFoundError, match="the folder is empty; expected images, a video, or fr"):
            resolve(tmp_path)

    def test_folder_without_a_sequence(self, tmp_path) -> None:
        (tmp_path / "notes.txt").write_text("nothing here")
        with pytest.raises(SourceNotFoundError, match="no sequence recognised") as caught:
            read(tmp_path)
        # It stands in columns of tables.
        assert len(caught.value.problem) < 350
        for kind in ("a video", "DICOM", "COLMAP", "transforms.json", "poses.json", "C3VD", "SimCol3D"):
            assert kind in caught.value.problem
        assert "docs/sources.md" in caught.value.problem

    def test_one_that_may_not_be_read(self, posed_folder, monkeypatch) -> None:
        source = resolve(posed_folder)

        def refuse(path: Path, *_: object) -> None:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

        monkeypatch.setattr(FolderReader, "glance", lambda self, path, *_: refuse(path))
        monkeypatch.setattr(FolderReader, "fingerprint", lambda self, path: refuse(path))
        for looked_at in (lambda: glance(posed_folder), lambda: source_fingerprint(source)):
            with pytest.raises(SourceError, match="it cannot be read: Permission denied") as error:
                looked_at()
            assert error.value.file == source.path
        monkeypatch.setattr(data_catalog.folders, "_recognised", refuse)
        with pytest.raises(SourceError, match="it cannot be read: Permission denied"):
            resolve(posed_folder)

    def test_a_reader_from_outside_is_named_with_its_layout(self, tmp_path, monkeypatch) -> None:
        def never(folder: Path) -> bool:
            return False

        reader = replace(posed_folder_reader, name="theirs", summary="one theirs.xml", recognises=never)
        monkeypatch.setattr("data_catalog.folders._registered", [reader])
        (tmp_path / "notes.txt").write_text("nothing here")
        with pytest.raises(SourceNotFoundError, match=r"or the sinus set, theirs \(one theirs\.xml\) \("):
            resolve(tmp_path)

    @pytest.mark.parametrize(("suffix", "kind"), [("mp4", "videos"), ("dcm", "DICOM files")])
    def test_several_recordings_are_named(self, tmp_path, suffix, kind) -> None:
        for name in (f"exam_10.{suffix}", f"exam_9.{suffix.upper()}", f"._exam_9.{suffix}"):
            (tmp_path / name).write_bytes(b"0")
        told = rf"2 {kind} in this folder: exam_9\.{suffix.upper()} and exam_10\.{suffix}; give the path"
        with pytest.raises(SourceError, match=told):
            resolve(tmp_path)

    def test_of_many_recordings_some_are_named(self, tmp_path) -> None:
        for number in range(9):
            (tmp_path / f"{number}.ts").write_bytes(b"0")
        with pytest.raises(SourceError, match=r"9 videos .*: 0\.ts, 1\.ts, 2\.ts, 3\.ts, 4\.ts and 4 more;"):
            resolve(tmp_path)


class TestPhantomSettings:
    def test_size_follows_the_settings(self) -> None:
        source = resolve("phantom/0")
        assert (
            PHANTOM.scene_config(source, IngestConfig()).width,
            PHANTOM.scene_config(source, IngestConfig()).height,
        ) == (
            160,
            128,
        )
        half = PHANTOM.scene_config(source, IngestConfig(downscale=2))
        assert (half.width, half.height) == (80, 64)
        assert PHANTOM.scene_config(source, IngestConfig(width=100)).height == 80
        assert PHANTOM.scene_config(source, IngestConfig(width=100, height=50)).height == 50

    def test_unusable_settings(self, posed_folder) -> None:
        with pytest.raises(ConfigError, match=r"ingest\.height needs ingest\.width"):
            PHANTOM.scene_config(resolve("phantom/0"), IngestConfig(height=64))
        with pytest.raises(ConfigError, match="too small"):
            PHANTOM.scene_config(resolve("phantom/0"), IngestConfig(downscale=16))
        with pytest.raises(ConfigError, match="is not a scene of phantom"):
            PHANTOM.scene_config(resolve(posed_folder), IngestConfig())

    def test_read_applies_them(self) -> None:
        sequence = read("phantom/7@distanced", IngestConfig(width=40, max_frames=4))
        assert sequence.rgb.shape == (4, 32, 40, 3)
        assert sequence.name == "phantom/7@distanced"
        assert sequence.split.name == "distanced"
        assert sequence.train.size >= 1
        assert sequence.test.size >= 1


class TestWhatIsNoName:
    def test_a_sequence_that_was_read(self) -> None:
        sequence = read("phantom/7@sparse", IngestConfig(width=40, max_frames=4))
        for function in (read, extrags.read):
            with pytest.raises(ConfigError, match=r"^phantom/7@sparse is a sequence that has been read"):
                function(sequence)

    @pytest.mark.parametrize(
        ("given", "kind"), [(7, "int"), (None, "NoneType"), ([1], "list"), (b"a", "bytes")]
    )
    def test_other_things(self, given, kind) -> None:
        for function in (read, extrags.read, resolve, glance, source_fingerprint):
            with pytest.raises(ConfigError, match=f"expected the name of a sequence or a path, found {kind}"):
                function(given)

    @pytest.mark.parametrize("given", ["", " "])
    def test_nothing(self, given, posed_folder, monkeypatch) -> None:
        """It is no other name of the folder one happens to be in."""
        monkeypatch.chdir(posed_folder)
        for function in (read, extrags.read, resolve, glance, source_fingerprint):
            with pytest.raises(UnknownSequenceError, match="the name is empty"):
                function(given)
        assert len(read(".")) == 10


class TestWhatAreNoSettingsOfReading:
    @pytest.mark.parametrize("given", [extrags.PROFILES["quick"], "quick", {}, {"width": 40}, 0])
    def test_are_refused(self, given) -> None:
        with pytest.raises(
            ConfigError, match=r"^read was given .* as its config; pass (an Ingest|its \.ingest)"
        ):
            extrags.read("phantom/7@sparse", given)
        for function in (glance, source_fingerprint, measured_detail):
            with pytest.raises(ConfigError, match=f"^{function.__name__} was given .* pass an Ingest"):
                function("phantom/7@sparse", given)


class TestPartsOfRecordings:
    """Frames without times have no part between two moments; once all of them were read without a word."""

    @pytest.mark.parametrize(
        ("settings", "told"),
        [
            ({"start_s": 5}, "ingest.start_s = 5 cut"),
            ({"end_s": 7.5}, "ingest.end_s = 7.5 cut"),
            ({"start_s": 5, "end_s": 7}, "ingest.start_s = 5 and ingest.end_s = 7 cut"),
        ],
    )
    def test_are_of_footage_alone(self, posed_folder, settings, told) -> None:
        config = IngestConfig.model_validate(settings)
        for source in (posed_folder, posed_folder / "rgb", "phantom/3@sparse"):
            for function in (read, glance):
                with pytest.raises(ConfigError, match=re.escape(told)) as caught:
                    function(source, config)
                assert "ingest.max_frames" in str(caught.value)

    def test_all_of_it_is_no_part(self, posed_folder) -> None:
        assert len(read(posed_folder, IngestConfig(start_s=0.0, end_s=None))) == 10


class TestFingerprint:
    def test_is_plain_json(self, posed_folder) -> None:
        for source in ("phantom/3@sparse", posed_folder):
            fingerprint = source_fingerprint(source)
            assert json.loads(json.dumps(fingerprint)) == fingerprint

    def test_phantom_depends_on_what_it_renders_only(self) -> None:
        plain = source_fingerprint("phantom/3@sparse")
        assert source_fingerprint("phantom/3") == plain
        assert source_fingerprint("phantom/3@sparse", IngestConfig(holdout_every=5)) == plain
        for other in ("phantom/4@sparse", "phantom/3@distanced"):
            assert source_fingerprint(other) != plain
        assert source_fingerprint("phantom/3@sparse", IngestConfig(width=80)) != plain

    def test_moved_folder_is_the_same_input(self, posed_folder: Path, tmp_path: Path) -> None:
        before = source_fingerprint(posed_folder)
        moved = tmp_path / "elsewhere" / "other_name"
        shutil.copytree(posed_folder, moved)
        assert source_fingerprint(moved) == before

    def test_one_changed_byte_is_another_input(self, posed_folder: Path) -> None:
        before = source_fingerprint(posed_folder)
        file = posed_folder / "depth" / "0003.npy"
        content = bytearray(file.read_bytes())
        content[-1] ^= 1
        file.write_bytes(bytes(content))
        assert source_fingerprint(posed_folder) != before

    def test_unrelated_files_do_not_count(self, posed_folder: Path) -> None:
        before = source_fingerprint(posed_folder)
        (posed_folder / "notes.txt").write_text("seen on Monday")
        assert source_fingerprint(posed_folder) == before


def test_a_size_is_given_once(posed_folder) -> None:
    """A divisor beside a width was passed over."""
    both = IngestConfig(width=32, downscale=2)
    expected = (
        r"ingest\.width = 32 and ingest\.downscale = 2 both set the size of frames; give one of the two"
    )
    for function in (read, glance, source_fingerprint):
        with pytest.raises(ConfigError, match=expected):
            function(posed_folder, both)
        with pytest.raises(ConfigError, match=expected):
            function("phantom/3@sparse", both)


def test_source_survives_pickling() -> None:
    source = resolve("phantom/2@distanced")
    assert pickle.loads(pickle.dumps(source)) == source
    assert Source.model_validate_json(source.model_dump_json()) == source


def test_reading_a_folder_twice_gives_the_same_bits(posed_folder) -> None:
    first, second = read(posed_folder), read(posed_folder)
    np.testing.assert_array_equal(first.rgb, second.rgb)
    np.testing.assert_array_equal(first.depth_mm, second.depth_mm)
