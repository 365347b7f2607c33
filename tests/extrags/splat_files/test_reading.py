"""Files of Gaussians from elsewhere, right and wrong ones."""

from __future__ import annotations

import gzip
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from extrags.errors import SourceError, SourceNotFoundError
from extrags.gaussians import Gaussians
from extrags.scene import Scene
from extrags.splat_files import read_splat_file, read_spz, write_compressed_ply, write_sog, write_spz
from extrags.splat_files.reading import splat_format


def packed(content: bytes) -> bytes:
    """Without the time of day: it would be in the names of tests, which processes must agree on."""
    return gzip.compress(content, mtime=0)


@pytest.fixture
def few(lit: Scene) -> Gaussians:
    return lit.gaussians.subset(torch.arange(20)).detached()


def with_values(gaussians: Gaussians, **values: torch.Tensor) -> Gaussians:
    return Gaussians(**{**gaussians.parameters(), **values})


class TestRefused:
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "neither PLY nor SPZ"),
            (
                b"PK\x03\x04",
                "a zip archive, as SOG files are: neither is read; export the scene as PLY or SPZ",
            ),
            (b"PK", "neither PLY nor SPZ"),
            (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "property is missing"),
            (b"\x1f\x8b\x08\x00", "SPZ"),
            (packed(b"short"), "ends within its header"),
            (packed(bytes(16)), "wrong magic number"),
            (
                packed(struct.pack("<4sIIBBBB", b"NGSP", 4, 1, 0, 12, 0, 0)),
                "SPZ of version 4; 2, 3 and 4",
            ),
            (struct.pack("<4sII20x", b"NGSP", 5, 1), "SPZ of version 5; 2, 3 and 4 are read"),
            (b"NGSP", "ends within its header"),
            (packed(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 4, 12, 0, 0)), "SH degree 4"),
            (packed(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**31, 0, 12, 0, 0)), "2147483648 Gaussians"),
            (packed(struct.pack("<4sIIBBBB", b"NGSP", 3, 5, 0, 12, 0, 0) + bytes(9)), "truncated"),
            (packed(struct.pack("<4sIIBBBB", b"NGSP", 3, 0, 0, 12, 0, 0)), "holds no Gaussians"),
        ],
    )
    def test_damaged_files(self, content: bytes, message: str, tmp_path: Path) -> None:
        file = tmp_path / "scene.spz"
        file.write_bytes(content)
        with pytest.raises(SourceError, match=message) as found:
            read_splat_file(file)
        assert found.value.file == str(file)

    def test_a_cloud_of_points_is_told_by_its_header(self, tmp_path: Path) -> None:
        """An import found out after it had read the frames."""
        file = tmp_path / "points.ply"
        properties = b"".join(b"property float " + name + b"\n" for name in (b"x", b"y", b"z"))
        file.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\n" + properties + b"end_header\n")
        with pytest.raises(SourceError, match="as in meshes and clouds of points") as found:
            splat_format(file)
        assert found.value.field == "opacity"

    def test_our_own_formats_that_are_not_read_are_named(self, few: Gaussians, tmp_path: Path) -> None:
        write_sog(few, tmp_path / "a.sog")
        write_compressed_ply(few, tmp_path / "a.ply")
        with pytest.raises(SourceError, match=r"zip archive, as SOG.*export the scene as PLY or SPZ"):
            read_splat_file(tmp_path / "a.sog")
        for read in (read_splat_file, Gaussians.read_ply):
            with pytest.raises(
                SourceError, match=r"a compressed PLY.*export the scene as PLY or SPZ"
            ) as found:
                read(tmp_path / "a.ply")
            assert found.value.file == str(tmp_path / "a.ply")

    def test_no_file(self, tmp_path: Path) -> None:
        for read in (read_splat_file, read_spz):
            with pytest.raises(SourceNotFoundError):
                read(tmp_path / "none.ply")

    def test_every_truncation(self, few: Gaussians, tmp_path: Path) -> None:
        write_spz(few, tmp_path / "whole.spz")
        whole = (tmp_path / "whole.spz").read_bytes()
        for length in range(0, len(whole), 37):
            (tmp_path / "part.spz").write_bytes(whole[:length])
            with pytest.raises(SourceError):
                read_splat_file(tmp_path / "part.spz")

    def test_numbers_that_are_not_finite(self, few: Gaussians, tmp_path: Path) -> None:
        few.scales[3, 1], few.scales[7, 0] = 1.2345, 2.3456
        few.write_ply(tmp_path / "a.ply")
        # Of another program: ours writes none.
        content = (tmp_path / "a.ply").read_bytes()
        for mark, value in ((1.2345, np.nan), (2.3456, np.inf)):
            assert content.count(np.float32(mark).tobytes()) == 1
            content = content.replace(np.float32(mark).tobytes(), np.float32(value).tobytes())
        (tmp_path / "a.ply").write_bytes(content)
        with pytest.raises(SourceError, match="field scales: 2 Gaussians"):
            read_splat_file(tmp_path / "a.ply")

    def test_rotations_without_length(self, few: Gaussians, tmp_path: Path) -> None:
        few.quats[2] = 0
        few.write_ply(tmp_path / "a.ply")
        with pytest.raises(SourceError, match="length zero"):
            read_splat_file(tmp_path / "a.ply")


class TestSpz:
    def test_our_own_reader(self, lit: Scene, tmp_path: Path) -> None:
        """Within half a step of each number's grid."""
        given = lit.gaussians.detached()
        write_spz(given, tmp_path / "a.spz")
        back = read_spz(tmp_path / "a.spz")
        assert torch.allclose(back.means, given.means, atol=1e-5)
        assert torch.allclose(back.scales, given.scales, atol=0.5 / 16 + 1e-6)
        assert torch.allclose(back.opacities.sigmoid(), given.opacities.sigmoid(), atol=0.5 / 255 + 1e-6)
        same = torch.nn.functional.cosine_similarity(back.quats, given.quats).abs()
        assert float(same.min()) > 1 - 1e-5
        assert torch.allclose(back.shN[:, 3:], given.shN[:, 3:], atol=1 / 16 + 1 / 256 + 1e-6)

    def test_version_2(self, tmp_path: Path) -> None:
        """Rotations of three bytes: x, y, z of 127.5 (1 + q), w not negative."""
        header = struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 12, 0, 0)
        position = b"".join((value << 12).to_bytes(3, "little", signed=True) for value in (1, -2, 3))
        rotation = bytes([128, 255, 128])
        body = position + bytes([128]) + bytes([128] * 3) + bytes([160] * 3) + rotation
        (tmp_path / "a.spz").write_bytes(gzip.compress(header + body))
        back = read_spz(tmp_path / "a.spz")
        assert back.means.tolist() == [[1.0, 2.0, -3.0]]
        assert back.scales.tolist() == [[0.0, 0.0, 0.0]]
        # About the format's y axis, which is our -y.
        assert torch.allclose(back.quats, torch.tensor([[0.0, 0.0, -1.0, 0.0]]), atol=0.01)

    def test_a_scene_too_large(self, few: Gaussians, tmp_path: Path) -> None:
        far = with_values(few, means=few.means * 1e6)
        with pytest.raises(SourceError, match="SPZ holds at most"):
            write_spz(far, tmp_path / "a.spz")


def version_4(gaussians: Gaussians, folder: Path, extensions: bytes = b"") -> bytes:
    """What `write_spz` writes, in the container of version 4."""
    from numcodecs.zstd import compress

    write_spz(gaussians, folder / "three.spz")
    whole = gzip.decompress((folder / "three.spz").read_bytes())
    _, _, count, degree, bits, *_ = struct.unpack("<4sIIBBBB", whole[:16])
    sizes = [count * size for size in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if size]
    ends = [16 + sum(sizes[:place]) for place in range(len(sizes) + 1)]
    streams = [compress(whole[a:b], 3) for a, b in pairwise(ends)]
    flags = 2 if extensions else 0
    header = struct.pack(
        "<4sIIBBBBI12x", b"NGSP", 4, count, degree, bits, flags, len(sizes), 32 + len(extensions)
    )
    table = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
    return header + extensions + table + b"".join(streams)


class TestSpzVersion4:
    @pytest.mark.parametrize("harmonics", [True, False])
    def test_the_same_as_version_3(self, few: Gaussians, harmonics: bool, tmp_path: Path) -> None:
        given = few if harmonics else with_values(few, shN=few.shN[:, :0])
        (tmp_path / "four.spz").write_bytes(version_4(given, tmp_path))
        found = read_splat_file(tmp_path / "four.spz").gaussians
        for name, values in read_spz(tmp_path / "three.spz").parameters().items():
            assert torch.equal(found.parameters()[name], values), name

    def test_extensions(self, few: Gaussians, tmp_path: Path) -> None:
        """Unknown ones are passed over; axes that are not the format's own are refused."""
        unknown = struct.pack("<II3s", 0xADBE0002, 3, b"abc")
        for number, message in ((4, None), (6, "axes are number 6"), (None, "extensions are damaged")):
            axes = unknown[:-1] if number is None else struct.pack("<III", 0xADBE0003, 4, number)
            (tmp_path / "four.spz").write_bytes(version_4(few, tmp_path, unknown + axes))
            if message is None:
                assert len(read_spz(tmp_path / "four.spz")) == len(few)
            else:
                with pytest.raises(SourceError, match=message):
                    read_spz(tmp_path / "four.spz")

    def test_damage(self, few: Gaussians, tmp_path: Path) -> None:
        whole = version_4(few, tmp_path)
        for length in range(4, len(whole), 41):
            (tmp_path / "part.spz").write_bytes(whole[:length])
            with pytest.raises(SourceError):
                read_splat_file(tmp_path / "part.spz")
        for count, message in ((len(few) + 1, "holds not the"), (2**31, "2147483648 Gaussians")):
            (tmp_path / "part.spz").write_bytes(whole[:8] + struct.pack("<I", count) + whole[12:])
            with pytest.raises(SourceError, match=message):
                read_spz(tmp_path / "part.spz")
        spoiled = whole[:15] + bytes([7]) + whole[16:]
        (tmp_path / "part.spz").write_bytes(spoiled)
        with pytest.raises(SourceError, match="streams"):
            read_spz(tmp_path / "part.spz")

    def test_a_stream_that_unpacks_to_more(self, few: Gaussians, tmp_path: Path) -> None:
        from numcodecs.zstd import compress

        whole = bytearray(version_4(few, tmp_path))
        (first,) = struct.unpack_from("<Q", whole, 32)
        streams = whole[15]
        begin = 32 + 16 * streams
        bomb = compress(bytes(10**6), 3)
        struct.pack_into("<Q", whole, 32, len(bomb))
        (tmp_path / "bomb.spz").write_bytes(bytes(whole[:begin]) + bomb + bytes(whole[begin + first :]))
        with pytest.raises(SourceError, match="stream 1"):
            read_spz(tmp_path / "bomb.spz")

    def test_a_small_file_of_many_gaussians_that_are_all_alike(self, tmp_path: Path) -> None:
        """It does hold them: Zstandard says in four bytes that 128 kB are one number."""
        from numcodecs.zstd import compress

        count = 100_000
        streams = [compress(bytes(count * size), 3) for size in (9, 1, 3, 3, 4, 45)]
        sizes = (len(stream) for stream in streams)
        table = b"".join(
            struct.pack("<QQ", n, count * k) for n, k in zip(sizes, (9, 1, 3, 3, 4, 45), strict=True)
        )
        header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 3, 12, 0, 6, 32)
        (tmp_path / "a.spz").write_bytes(header + table + b"".join(streams))
        with pytest.raises(
            SourceError, match=r"a\.spz, field count: 100000 Gaussians of 6500000 bytes"
        ) as told:
            read_splat_file(tmp_path / "a.spz")
        assert told.value.field == "count"


def test_an_spz_that_announces_more_than_gzip_can_hold_takes_no_memory(
    tmp_path: Path,
) -> None:
    content = packed(struct.pack("<4sIIBBBB", b"NGSP", 3, 10_000_000, 3, 12, 0, 0) + bytes(1000))
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(SourceError, match="10000000 Gaussians of 650000000 bytes announced in a file of"):
        read_splat_file(tmp_path / "a.spz")
