"""What the tests of sweeps stand on."""

import sqlite3

import pytest
from sqlalchemy import event
from sqlalchemy.engine import Engine


@pytest.fixture(autouse=True, scope="session")
def no_wait_for_the_disk():
    """SQLite waits for the disk at each of the two dozen commits of a trial, but not here."""

    def connected(connection, _):
        if isinstance(connection, sqlite3.Connection):
            connection.execute("PRAGMA synchronous=OFF")

    event.listen(Engine, "connect", connected)
    yield
    event.remove(Engine, "connect", connected)
