"""Addresses of Rerun viewers, as the option --live and `mjfim.live` take them."""

from __future__ import annotations

import re

from mjfim.errors import ExperimentError

# Port at which a viewer listens if it is not told another one.
DEFAULT_PORT = 9876
DEFAULT_ADDRESS = f"127.0.0.1:{DEFAULT_PORT}"

# Address that stands for the viewer of this computer, which may be opened.
HERE = "here"

# Form of an address: a host with a port, or a URL of Rerun.
ADDRESS = re.compile(r"rerun(\+https?)?://\S+|[\w.-]+:\d{1,5}")


def url_of(address: str) -> str:
    """Return the URL of a viewer.

    Args:
        address: A host with a port, or a URL of Rerun.

    Raises:
        ExperimentError: The address has another form.
    """
    if not ADDRESS.fullmatch(address):
        raise ExperimentError(
            f"--live {address}: an address is HOST:PORT, such as {DEFAULT_ADDRESS}, or a URL that "
            "begins with rerun+http://"
        )
    return address if "://" in address else f"rerun+http://{address}/proxy"
