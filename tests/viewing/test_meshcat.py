"""The server and its port, waiting for a browser."""

import pytest

from iga_drake.errors import ConfigError
from iga_drake.viewing.meshcat import Visualization, start_meshcat, wait_for_browser


def test_a_taken_port_is_refused_and_the_next_free_one_taken():
    first = start_meshcat()
    with pytest.raises(ConfigError, match=rf"visualization\.port: {first.port()} can't be used"):
        start_meshcat(Visualization(port=first.port()))
    second = start_meshcat()
    assert second.port() != first.port()
    for meshcat in (first, second):  # nobody else's business
        assert meshcat.web_url().startswith("http://localhost:")


def test_a_browser_is_waited_for_no_longer_than_asked():
    assert not wait_for_browser(start_meshcat(), 0.1)
