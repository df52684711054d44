"""PageSource: a beam monitor's text from a web page or a file, as facilities publish their ring current."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from urllib.parse import urlsplit

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout

MOST_BYTES = 1 << 20  # Bytes of a page that are read at most; the number must stand within them
_PIECE = 1 << 14


class PageSource:
    """Implements `drivers.beam_monitors.reading.TextSource` over http, https or file.

    No proxy is used: the page is in the facility's own network.

    Args:
        url: http://..., https://... or file:///...
        timeout: s, for the whole page and for each wait on the network.

    Raises:
        DeviceRefused: the URL is of another kind.
    """

    def __init__(self, url: str, clock: Clock, *, timeout: float = 2.0, name: str = "beam monitor") -> None:
        if problem := url_problem(url):
            raise DeviceRefused(name, problem, state="Nothing was asked")
        self.request = url
        self._name, self._clock, self._timeout = name, clock, timeout
        self._opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def text(self) -> str:
        """The text of the page, at most MOST_BYTES of it. Raises DeviceTimeout, DeviceError."""
        deadline = self._clock.now() + self._timeout
        try:
            with self._opener.open(self.request, timeout=self._timeout) as page:
                charset = page.headers.get_content_charset() or "utf-8"
                data = bytearray()
                # read1 returns the bytes received so far; `read` would wait for ever on a server that sends slowly.
                while len(data) < MOST_BYTES and (piece := getattr(page, "read1", page.read)(_PIECE)):
                    data += piece
                    if self._clock.now() > deadline:
                        raise TimeoutError("the page does not end")
        except urllib.error.HTTPError as error:
            error.close()
            raise self._error(DeviceError, f"the server answers {error.code} {error.reason}") from error
        except TimeoutError as error:
            raise self._error(DeviceTimeout, f"no whole page within {self._timeout:g} s") from error
        except urllib.error.URLError as error:
            if isinstance(error.reason, TimeoutError):
                raise self._error(DeviceTimeout, f"no whole page within {self._timeout:g} s") from error
            raise self._error(DeviceError, f"the page cannot be read ({error.reason})") from error
        except (OSError, http.client.HTTPException) as error:
            raise self._error(DeviceError, f"the page cannot be read ({error or type(error).__name__})") from error
        try:
            return data.decode(charset, errors="replace")
        except LookupError:  # a charset unknown to Python: digits are ASCII in nearly every charset
            return data.decode("ascii", errors="replace")

    def close(self) -> None:
        """Does nothing: no connection stays open between readings."""

    def _error(self, kind: type[DeviceError], problem: str) -> DeviceError:
        return kind(
            self._name,
            problem,
            request=self.request,
            advice="Check the address in the configuration, the network, and that the page opens in a browser",
        )


def url_problem(url: str) -> str:
    """Reason for which a URL cannot be read; "" if it can."""
    try:
        parts = urlsplit(url)
        legal = parts.scheme == "file" or (parts.scheme in ("http", "https") and bool(parts.hostname))
    except ValueError:
        legal = False
    return "" if legal else f"{url!r} is not the address of a page: http://host/..., https://host/... or file:///..."
