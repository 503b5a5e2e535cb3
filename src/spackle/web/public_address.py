"""How clients reach a server that stands behind a reverse proxy, such as nginx or Caddy."""

from __future__ import annotations

import dataclasses
import ipaddress
import re
from urllib.parse import urlsplit

from starlette.datastructures import Headers

from spackle.runtime.errors import InputError

NAME_PATTERN = re.compile(r"[a-z0-9]([a-z0-9._-]*[a-z0-9])?")  # a host name in lower case
# The origin of a page: scheme, host name in lower case, and perhaps a port.
ORIGIN_PATTERN = re.compile(rf"https?://{NAME_PATTERN.pattern}(:\d{{1,5}})?")
USUAL_PORTS = {"http": 80, "https": 443}  # which addresses leave out


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublicAddress:
    """The names of a server outside of its machine, and the proxies that it believes.

    Only what is named here is accepted besides the machine's own names. InputError for a value that
    is no name or address.
    """

    allowed_hosts: tuple[str, ...] = ()  # further host names, such as "photos.example.com"
    # Where the page is for its users, such as "https://example.com/photos", or None.
    url: str | None = None
    # Addresses or networks of proxies, whose X-Forwarded headers are believed.
    proxies: tuple[str, ...] = ()
    # Origins of pages of other sites that may use the interface (CORS), such as
    # "https://gallery.example.com". They need the token as any other client.
    page_origins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """InputError for a value that cannot be used."""
        for name in self.allowed_hosts:
            if not NAME_PATTERN.fullmatch(name.lower()):
                raise InputError(
                    f"`allowed_host` {name}: no host name: give one such as photos.example.com, "
                    "without http:// and port; several by several options"
                )
        if self.url is not None:
            self._check_url(self.url)
        for origin in self.page_origins:
            if not ORIGIN_PATTERN.fullmatch(origin.lower()):
                raise InputError(
                    f"`cors` {origin}: no origin of pages: give one such as "
                    "https://gallery.example.com, without a path"
                )
        for proxy in self.proxies:
            try:
                ipaddress.ip_network(proxy)
            except ValueError as error:
                raise InputError(
                    f"`proxy` {proxy}: no address: give one such as 127.0.0.1, or a network such "
                    "as 172.18.0.0/16"
                ) from error

    @staticmethod
    def _check_url(url: str) -> None:
        """InputError for an address that leads to no page."""
        try:
            parts = urlsplit(url)
            usable = (
                parts.scheme in USUAL_PORTS
                and NAME_PATTERN.fullmatch((parts.hostname or "").lower())
                and not (parts.query or parts.fragment or parts.username)
                and parts.port != 0
            )
        except ValueError:  # a port that is no number
            usable = False
        if not usable:
            raise InputError(
                f"`public_url` {url}: no address of a page: give one such as "
                "https://photos.example.com or https://example.com/photos"
            )

    @property
    def names(self) -> frozenset[str]:
        """All host names of the server outside of its machine, in lower case."""
        names = {name.lower() for name in self.allowed_hosts}
        if self.url is not None:
            names.add((urlsplit(self.url).hostname or "").lower())
        return frozenset(names)

    @property
    def origin(self) -> str | None:
        """What a browser sends as Origin from a page at `url`, such as "https://example.com"."""
        if self.url is None:
            return None
        parts = urlsplit(self.url)
        port = parts.port
        written_port = "" if port in (None, USUAL_PORTS[parts.scheme]) else f":{port}"
        return f"{parts.scheme}://{(parts.hostname or '').lower()}{written_port}"

    @property
    def path(self) -> str:
        """The path of `url`, without a slash at its end: "/photos", or an empty text."""
        return "" if self.url is None else urlsplit(self.url).path.rstrip("/")

    def admitted_origin(self, headers: Headers) -> str | None:
        """The origin of the page of another site that asks, if it may use the interface."""
        origins = headers.getlist("origin")
        admitted = {origin.lower() for origin in self.page_origins}
        if len(origins) == 1 and origins[0].strip().lower() in admitted:
            return origins[0].strip()
        return None

    def asked_hosts(self, headers: Headers, client: tuple[str, int] | None) -> list[str]:
        """The values of the header Host, as the client's browser sent it.

        A proxy may write its own name there, and the client's into X-Forwarded-Host. That is
        believed only if the request comes from a proxy that the user has named.

        Args:
            headers: of the request.
            client: address and port of the other end of the connection.
        """
        forwarded = headers.getlist("x-forwarded-host")
        if not forwarded or client is None or not self._is_proxy(client[0]):
            return headers.getlist("host")
        # Each proxy of a chain adds a name at the end; only the last one is the named proxy's.
        return [forwarded[-1].split(",")[-1]]

    def _is_proxy(self, address: str) -> bool:
        """Whether the user has named the proxy with this numeric address."""
        try:
            peer = ipaddress.ip_address(address.partition("%")[0])
        except ValueError:
            return False
        # A socket for both protocols shows IPv4 addresses inside IPv6 ones.
        peer = getattr(peer, "ipv4_mapped", None) or peer
        return any(peer in ipaddress.ip_network(proxy) for proxy in self.proxies)


LOCAL_ONLY = PublicAddress()  # no name outside of this machine, and no proxy
