"""A camera on 127.0.0.1 that sends what it is told to, and then ends, or goes silent without ending."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def serve_stream(data: bytes, *, stall: bool = False) -> Iterator[str]:
    """URL under which `data` (MPEG-TS) comes; with `stall` the connection then stays open and silent."""
    over = threading.Event()

    class Camera(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "video/mp2t")
            self.end_headers()
            try:
                self.wfile.write(data)
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
