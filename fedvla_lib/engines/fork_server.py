"""A script that the library starts but never imports: it has loaded heavy libraries, and forks a process per call.

::

    python fork_server.py serve MODULE...                     serve calls on the Unix socket that is standard input
    python fork_server.py call SOCKET SCRIPT [ARGUMENT...]    run a Python script in a fork of that server

A call stays alive as long as its script: it passes signals on and returns the exit status. If the call is killed, so is
the script; if there is no server, it runs the script in the ordinary way.
"""

import gc
import importlib
import json
import logging
import os
import runpy
import select
import signal
import socket
import sys

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
STARTED = b"started\n"


def call(address: str, command: list[str]) -> int:
    """Run a script in a fork of the server and return its exit status, 128 + n if it was ended by signal n."""
    connection = socket.socket(socket.AF_UNIX)
    ignored = [number for number in SIGNALS if signal.getsignal(number) == signal.SIG_IGN]  # as nohup has it
    try:
        connection.connect(address)
        socket.send_fds(connection, [b"!"], [0, 1, 2])
        connection.sendall(json.dumps([os.getcwd(), dict(os.environ), command, ignored]).encode() + b"\n")
        answer = connection.makefile("rb")
        started = answer.readline() == STARTED
    except OSError:
        started = False
    if not started:  # the server was killed
        os.execv(sys.executable, [sys.executable, *command])
    for number in set(SIGNALS) - set(ignored):
        signal.signal(number, lambda number, _: connection.sendall(bytes([number])))
    return int(answer.readline() or 1)


def serve(modules: list[str]) -> list[str]:
    """Serve calls until killed; return, only in a fork, the command that it is to run.

    The server only imports, since a fork of a process that runs threads or has used a GPU is not safe. OpenBLAS and
    jemalloc start a thread at import, and are prepared for forks.
    """
    listener = socket.socket(fileno=os.dup(0))
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # a fork that kept the socket would let calls wait for a dead server
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # forks need not be waited for
    gc.disable()  # a fifth of the time would be collections
    for module in modules:
        importlib.import_module(module)
    gc.freeze()  # collections in a fork would copy the memory that it shares
    gc.enable()
    logging.getLogger().handlers.clear()  # LeRobot adds one, and Flower's lines would appear twice
    while True:
        connection, _ = listener.accept()
        if os.fork() == 0:
            listener.close()
            return _answer(connection)
        connection.close()


def _answer(connection: socket.socket) -> list[str]:
    """Fork the process that runs the command, and watch over it; return only in that process."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _, files, *_ = socket.recv_fds(connection, 1, 3)
    folder, environment, command, ignored = json.loads(connection.makefile("rb").readline())
    if child := os.fork():
        _watch(connection, child)
        os._exit(0)
    connection.close()
    for number, file in enumerate(files):
        os.dup2(file, number)
        os.close(file)
    for number in SIGNALS:  # the server may ignore others than the caller
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number in ignored else usual)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    return command


def _watch(connection: socket.socket, child: int) -> None:
    """Pass signals of the caller on to a child process, kill it once the caller is gone, and report its status."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    connection.sendall(STARTED)
    exited = os.pidfd_open(child)
    while exited not in select.select([connection, exited], [], [])[0]:
        numbers = connection.recv(1)
        if not numbers:
            return _kill(child)
        os.kill(child, numbers[0])
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    connection.sendall(f"{status if status >= 0 else 128 - status}\n".encode())


def _kill(child: int) -> None:
    """Kill a process after its descendants, so that whoever stops the server finds those that are left."""
    import psutil  # calls start without site-packages, which takes a tenth of the time

    leader = psutil.Process(child)
    for process in [*reversed(leader.children(recursive=True)), leader]:
        try:
            process.kill()
        except psutil.NoSuchProcess:  # it ended by itself
            continue


def main() -> None:
    """Serve or call, as the first argument says; in a fork, run the script as if Python had been started with it."""
    if sys.argv[1] == "call":
        sys.exit(call(sys.argv[2], sys.argv[3:]))
    sys.argv[:] = serve(sys.argv[2:])
    added = os.environ.get("PYTHONPATH", "").split(os.pathsep)  # Ray's workers have a path of their own
    sys.path[:0] = [os.path.dirname(sys.argv[0]), *filter(None, added)]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
