"""A federation whose nodes have hosts of their own keeps in bad weather what the deployment page promises."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(FOLDER))
import hosts  # noqa: E402
import network  # noqa: E402

REFUSED = hosts.refusal()
alone = pytest.mark.skipif(bool(REFUSED), reason=REFUSED)


@pytest.fixture
def there():
    with hosts.network(2) as network:
        yield network


def fetched(centre, host, address, count, timeout_s=20.0):
    """Seconds until a host has received so many bytes from a program on the central host, or None."""
    listener = centre.call(lambda: socket.create_server(("0.0.0.0", 0)))
    port = listener.getsockname()[1]
    code = f"""
import socket, time
began, got = time.monotonic(), 0
with socket.create_connection(("{address}", {port}), timeout={timeout_s}) as line:
    while got < {count} and (part := line.recv(65536)):
        got += len(part)
print(time.monotonic() - began if got == {count} else None)
"""
    command = ["ip", "netns", "exec", host.name, sys.executable, "-IS", "-c", code]
    with listener, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        listener.settimeout(timeout_s)
        try:
            connection, _ = listener.accept()
            with connection:
                connection.sendall(bytes(count))
        except TimeoutError:
            return None
        return json.loads(client.communicate()[0].replace("None", "null") or "null")


@alone
@pytest.mark.integration
def test_a_line_delays_narrows_and_cuts_and_leaves_other_lines_alone(there):
    centre, (one, other), (first, second) = there
    good = fetched(centre, one, first.address, 100_000)
    first.delay_s = 0.2
    late = fetched(centre, one, first.address, 100_000)
    first.mend()
    first.bytes_per_s = 50_000
    narrow = fetched(centre, one, first.address, 100_000)
    assert good < 0.2 < 0.4 <= late and 1.5 < narrow  # there and back
    assert first.late > 0 == second.lost
    first.is_cut, first.lost = True, 0
    assert fetched(centre, one, first.address, 1, timeout_s=2.0) is None and first.lost > 0
    assert fetched(centre, other, second.address, 100_000) < 1.0
    assert min(second.carried) > 0 and sum(second.carried) > 100_000


@alone
@pytest.mark.integration
def test_a_host_knows_the_names_that_it_was_told_and_leaves_nothing_behind(there):
    centre, (one, _), lines = there
    ask = ["ip", "netns", "exec", one.name, sys.executable, "-IS", "-c"]
    code = "import socket; print(socket.gethostbyname('server.example.org'))"
    assert subprocess.run([*ask, code], capture_output=True).returncode != 0
    one.know({"server.example.org": lines[0].address})
    assert subprocess.run([*ask, code], capture_output=True, text=True).stdout.strip() == lines[0].address
    listener = centre.call(lambda: socket.create_server(("0.0.0.0", 0)))
    at_home = centre.call(lambda: socket.create_server(("127.0.0.1", 0)))
    with listener, at_home:
        assert network.sockets(centre) == [listener.getsockname()[1]]
    assert network.sockets(centre) == []


@alone
@pytest.mark.integration
def test_no_network_is_left_behind():
    with hosts.network(1) as (centre, _, _):
        assert (hosts.RUNNING / centre.name).exists()
    assert not (hosts.RUNNING / centre.name).exists() and not (hosts.NAMES / centre.name).exists()


@alone
@pytest.mark.network
def test_what_is_promised_is_kept_in_every_weather(tmp_path):
    command = [sys.executable, FOLDER / "network.py", "--profile", "tiny", "--out", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3600)
    assert done.returncode == 0, done.stderr[-2000:]
    rows = json.loads((tmp_path / "network.json").read_text())["rows"]
    assert_promises_were_kept(rows)


def assert_promises_were_kept(rows):
    assert [row["the network"] for row in rows] == list(network.CASES)
    for row in rows:
        assert row["promised"] == row["happened"] == network.CASES[row["the network"]][0] and row["kept"], row


@pytest.mark.unit
def test_the_stored_table_has_every_case():
    rows = json.loads((FOLDER / "results/network.json").read_text())["rows"]
    assert_promises_were_kept(rows)
