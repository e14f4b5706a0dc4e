"""A camera on 127.0.0.1 that sends what it is told to, and then ends, or goes silent without ending."""

from __future__ import annotations

import http.server
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


@contextmanager
def serve_stream(
    data: bytes | Sequence[bytes],
    *,
    stall: bool = False,
    announced: int | None = None,
    kind: str = "video/mp2t",
    every_s: float = 0.0,
) -> Iterator[str]:
    """URL under which `data` comes, in pieces every so many seconds if so asked.

    With `stall` the connection then stays open and silent. `announced` is the length that the server states; a
    transfer without one, or of fewer bytes, counts as cut short.
    """
    pieces = [data] if isinstance(data, bytes) else data
    over = threading.Event()

    class Camera(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            if announced is not None:
                self.send_header("Content-Length", str(announced))
            self.end_headers()
            begun_s = time.monotonic()
            try:
                for number, piece in enumerate(pieces):
                    if over.wait(max(0.0, begun_s + number * every_s - time.monotonic())):
                        return
                    self.wfile.write(piece)
                    self.wfile.flush()
            except OSError:
                return  # the reader has left
            if stall:
                over.wait(60)

        def log_message(self, *arguments: object) -> None:
            """Quiet."""

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/camera.ts"
    finally:
        over.set()
        server.shutdown()
        server.server_close()
        thread.join(10)
