"""The gallery: which views, their figures, the files beside the page."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from extrags.errors import ConfigError
from extrags.report import ReportInputs
from extrags.report.encode import UNSEEN_RGB
from extrags.report.gallery import GalleryRun, build_gallery


@pytest.fixture(scope="module")
def run(inputs: ReportInputs) -> GalleryRun:
    return GalleryRun(
        inputs.sequence,
        {"coarse": inputs.coarse.rgb, "final": inputs.final.rgb},
        {"coarse": inputs.coarse_metrics, "final": inputs.final_metrics},
        method="extrags", profile="quick", pseudo=inputs.pseudo,
    )  # fmt: skip


def built(runs: list[GalleryRun], folder: Path, largest_bytes: int = 400_000) -> str:
    page = build_gallery(runs, folder, title="Some", command="extrags gallery", largest_bytes=largest_bytes)
    return page.read_text(encoding="utf-8")


def test_every_image_is_there_with_words(run: GalleryRun, tmp_path: Path) -> None:
    text = built([run], tmp_path)
    images = re.findall(r"!\[(.+?)\]\((.+?)\)", text)
    assert {file for _, file in images} == {file.name for file in tmp_path.glob("*.png")}
    assert len(images) == 5 + 6
    for alt, file in images:
        assert len(alt) > 10
        with Image.open(tmp_path / file) as image:
            assert image.size == (48, 40)
    heads = [line for line in text.splitlines() if line.startswith("| Truth")]
    assert heads == ["| Truth | Coarse | Final | Never observed | Error, final |"]
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert widths == {6, 7}


def test_the_view_is_the_median_one(run: GalleryRun, tmp_path: Path) -> None:
    """PSNR rises with the frame; frames 6 to 10 are held out."""
    text = built([run], tmp_path)
    assert "frame b_008" in text
    assert "PSNR 20.00 dB" in text
    assert "PSNR 22.50 dB" in text
    assert "Means of 5 held-out views, coarse → final: PSNR 20.00 → 22.50 dB" in text
    shown = np.asarray(Image.open(tmp_path / "000_tube_0_sparse_view_1.png"))
    assert (shown == run.sequence.rgb[8]).all()


def test_source_and_licence_stand_beside_the_pictures(run: GalleryRun, tmp_path: Path) -> None:
    known = replace(run, source="A colon, ten frames", licence="CC BY-NC-SA 4.0")
    text = built([known, run], tmp_path)
    first, second = text.split("\n## ")[1:]
    assert "Pictures derive from: A colon, ten frames. Licence: CC BY-NC-SA 4.0.\n" in first
    assert "The catalogue knows no licence of these frames" in second


def test_what_no_frame_saw_is_tinted(run: GalleryRun, tmp_path: Path) -> None:
    built([run], tmp_path)
    shown = np.asarray(Image.open(tmp_path / "000_tube_0_sparse_view_4.png")).astype(int)
    tinted = shown[..., 2] > shown[..., 0] + 20
    assert (tinted == ~run.sequence.observed[8]).all()


def test_never_observed_has_one_colour_in_gallery_and_reports(run: GalleryRun, tmp_path: Path) -> None:
    text = built([run], tmp_path)
    assert "Cyan in *never observed*" in text
    brightest = np.asarray(Image.open(tmp_path / "000_tube_0_sparse_view_4.png")).astype(int)
    tint = brightest[~run.sequence.observed[8]].astype(float)
    assert np.allclose(tint / tint[:, 2:], np.array(UNSEEN_RGB) / UNSEEN_RGB[2], atol=0.02)


def test_runs_of_one_name_have_pictures_of_their_own(run: GalleryRun, tmp_path: Path) -> None:
    """Folders of the same name, or names without a letter that a file may have."""
    other = replace(run, sequence=replace(run.sequence, rgb=255 - run.sequence.rgb))
    for name in (run.sequence.name, "患者一"):
        both = [replace(one, sequence=replace(one.sequence, name=name)) for one in (run, other)]
        folder = tmp_path / str(len(name))
        images = re.findall(r"!\[.+?\]\((.+?)\)", built(both, folder))
        assert len(set(images)) == len(images) == 2 * (5 + 6)
        truths = [np.asarray(Image.open(folder / file)) for file in images if file.endswith("view_1.png")]
        assert (truths[0] == 255 - truths[1]).all()


def test_without_virtual_views_or_final_scene(run: GalleryRun, tmp_path: Path) -> None:
    bare = replace(
        run, pseudo=None, rgb={"coarse": run.rgb["coarse"]}, results={"coarse": run.results["coarse"]}
    )
    text = built([bare], tmp_path)
    assert "Virtual view" not in text
    assert "| Truth | Coarse | Never observed |" in text


def test_the_images_keep_to_their_bound(run: GalleryRun, tmp_path: Path) -> None:
    built([run], tmp_path, 70_000)
    assert sum(file.stat().st_size for file in tmp_path.glob("tube*")) <= 70_000


def test_no_runs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="one run or more"):
        built([], tmp_path)


def test_names_end_no_cell(run: GalleryRun, tmp_path: Path) -> None:
    names = tuple(f"a|b](x)<{k}" for k in range(11))
    text = built([replace(run, sequence=replace(run.sequence, frame_names=names))], tmp_path)
    assert "a b" in text
    assert {line.count("|") for line in text.splitlines() if line.startswith("|")} == {6, 7}


def test_names_make_no_part_of_the_page(run: GalleryRun, tmp_path: Path) -> None:
    names = tuple(f"<img src=x onerror=alert({index})>\x1b]0;{index}" for index in range(len(run.sequence)))
    text = built([replace(run, sequence=replace(run.sequence, frame_names=names))], tmp_path)
    assert "img src=x" in text
    assert "<" not in text
    assert "\x1b" not in text


def test_a_name_in_the_command_does_not_end_its_block(run: GalleryRun, tmp_path: Path) -> None:
    page = build_gallery(
        [run], tmp_path, title="Some", command="extrags gallery 'a\n```\nb'", largest_bytes=400_000
    )
    assert "\n````bash\nextrags gallery 'a\n```\nb'\n````\n" in page.read_text(encoding="utf-8")
