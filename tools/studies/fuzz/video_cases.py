"""Makers of cases of videos: files with changed bytes and stamps, and cameras that send anything."""

from __future__ import annotations

import contextlib
import socket
import threading
from fractions import Fraction
from pathlib import Path
from typing import Any

import av

from tools.studies.fuzz.changes import change_bytes
from tools.studies.fuzz.good_files import VIDEOS, Case, Rng, scene_options

__all__ = ["streams_case", "videos_case"]

_COMMANDS = ("speed", "speed", "bcs-masks", "calibrate", "road-mask", "rectify", "detect", "synth")


def videos_case(rng: Rng, good: Path, work: Path) -> Case:
    """Return a command that reads a video with changed bytes, stamps or name."""
    suffix = list(VIDEOS)[rng.integers(len(VIDEOS))]
    path = work / f"road.{suffix}"
    if rng.random() < 0.3:
        path = work / "road.mkv"
        change = _write_strange_stamps(rng, good / "road.mp4", path)
    else:
        content, change = change_bytes(rng, (good / path.name).read_bytes())
        path.write_bytes(content)
    masks = f"coco:{good / 'masks.json'}"
    scene, out = scene_options(good), ["--out", work / "out"]
    fps = ["--fps", 10] if rng.random() < 0.5 else []
    command = _COMMANDS[rng.integers(len(_COMMANDS))]
    arguments: dict[str, list[object]] = {
        "speed": ["speed", path, "--from", f"masks:{masks}", *scene, *fps, *out],
        "bcs-masks": ["bcs-masks", path, "--masks", masks, "--every", 2, "--size", "160x96", *scene, *fps, *out],
        "calibrate": ["calibrate", path, "--duration", 2, *fps, "--out", work / "out.json"],
        "road-mask": ["road-mask", path, "--duration", 2, *fps, "--out", work / "out.png"],
        "rectify": ["rectify", path, "--frame", int(rng.integers(12)), *scene, *fps, "--out", work / "out.png"],
        "detect": ["detect", good / "last.ckpt", path, "--device", "cpu", *scene, *fps, *out],
        "synth": ["synth", "session", "--scene", path, *scene, "--duration", 0.2, "--no-video", *out],
    }  # fmt: skip
    return arguments[command], f"{path.name}: {change}"


def _write_strange_stamps(rng: Rng, source: Path, target: Path) -> str:
    """Copy the packets of a video with stamps that jump."""
    kind = int(rng.integers(5))
    with av.open(str(source)) as old, av.open(str(target), "w") as new:
        stream: Any = new.add_stream_from_template(old.streams.video[0])
        step = Fraction(1, 10) / old.streams.video[0].time_base
        for number, packet in enumerate(old.demux(video=0)):
            if packet.dts is None:
                continue
            packet.stream = stream
            factor = (0, 1000, 1_000_000, number % 3, 10**8)[kind]
            packet.pts = packet.dts = round(float(number * step * factor))
            with contextlib.suppress(av.error.FFmpegError, ValueError, OverflowError):
                new.mux(packet)
    return f"stamps, kind {kind}"


def streams_case(rng: Rng, good: Path, work: Path) -> Case:
    """Return a command that reads a camera's changed stream, or an address that is none."""
    options = ["--from", f"masks:coco:{good / 'masks.json'}", *scene_options(good), "--stall", 1, "--out", work / "out"]
    if rng.random() < 0.4:
        addresses = [
            "http://127.0.0.1:1/x.ts", "rtsp://127.0.0.1:1/a", "http://[::1", "http://", "file:///etc/hostname",
            "concat:/etc/hostname", "pipe:0", "data:text/plain,x", "http://user:secret@127.0.0.1:1/x", "rtmp://:@/",
            "udp://", "srt://x", "http://127.0.0.1:99999/x", "http://\x1b[2J/x", "tcp://127.0.0.1:1?listen=1",
            f"http://127.0.0.1:1/{'x' * 5000}", "crypto:http://x", "http://127.0.0.1:1/%00",
        ]  # fmt: skip
        address = addresses[rng.integers(len(addresses))]
        return ["speed", address, *options], f"address {address[:60]!r}"
    name = ("road.ts", "road.mjpeg", "road.mkv", "road.avi")[rng.integers(4)]
    content, change = change_bytes(rng, (good / name).read_bytes())
    head = b"HTTP/1.0 200 OK\r\nContent-Type: video/x\r\n" + (
        b"Content-Length: 99999\r\n" if rng.random() < 0.3 else b""
    )
    kind = int(rng.integers(6))
    if kind == 0:
        head, change = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nfffffff\r\n", f"{change}, a false length"
    elif kind == 1:
        head, change = b"HTTP/1.0 302 Found\r\nLocation: file:///etc/hostname\r\n", "redirected to a file"
    return ["speed", _serve_once(head + b"\r\n" + content), *options], f"{name} served: {change}"


def _serve_once(answer: bytes) -> str:
    """Answer each request on a port with the same bytes; return the address."""
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(30)

    def serve() -> None:
        with server, contextlib.suppress(OSError):
            while True:
                connection, _ = server.accept()
                with connection, contextlib.suppress(OSError):
                    connection.settimeout(5)
                    connection.recv(4096)
                    connection.sendall(answer)

    threading.Thread(target=serve, daemon=True).start()
    return f"http://127.0.0.1:{server.getsockname()[1]}/road"
