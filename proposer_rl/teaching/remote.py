"""A teacher for other processes, whose clients are answered by threads of its own process."""

from __future__ import annotations

import os
import pickle
from contextlib import suppress
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener
from threading import Lock, Thread
from typing import Any


class TeacherClient:
    """Stands for a teacher in another process; :meth:`Teacher.client` makes it, to be sent there.

    The order in which several processes ask is not fixed, so that such runs do not repeat each
    other.
    """

    def __init__(self, address: Any, key: bytes, required_results: tuple[str, ...]) -> None:
        self._address, self._key = address, key
        self.required_results = required_results
        self._connection: Connection | None = None
        self._process = 0
        self._lock = Lock()

    def ask(self, n: int | None = None) -> tuple[Any, Any]:
        """Returns the next levels and their tickets, see :meth:`Teacher.ask`."""
        return self._call("ask", n)

    def tell(self, ids: Any, return_: Any, success: Any = None, **more: Any) -> None:
        """Reports the results of levels, see :meth:`Teacher.tell`."""
        self._call("tell", ids, return_, success, **more)

    def drop(self, ids: Any = None) -> None:
        """Gives up levels, see :meth:`Teacher.drop`."""
        self._call("drop", ids)

    def __reduce__(self) -> Any:
        return TeacherClient, (self._address, self._key, self.required_results)

    def _call(self, name: str, *arguments: Any, **more: Any) -> Any:
        with self._lock:
            try:
                if self._connection is None or self._process != os.getpid():
                    self._connection = Client(self._address, authkey=self._key)
                    self._process = os.getpid()
                self._connection.send_bytes(pickle.dumps((name, arguments, more)))
                result, error = pickle.loads(self._connection.recv_bytes())
            except (AuthenticationError, EOFError, OSError) as lost:  # or its place was taken
                raise RuntimeError("the process of the teacher has ended") from lost
        if error is not None:
            raise error
        return result


class TeacherServer:
    """Answers clients of a teacher from threads of this process."""

    def __init__(self, teacher: Any) -> None:
        self._teacher, self._key = teacher, os.urandom(32)
        try:
            self._listener = Listener(authkey=self._key)
        except OSError:  # a socket's path below a long TMPDIR
            self._listener = Listener(("127.0.0.1", 0), authkey=self._key)
        Thread(target=self._accept, daemon=True).start()

    def client(self) -> TeacherClient:
        """Returns a new client."""
        return TeacherClient(self._listener.address, self._key, self._teacher.required_results)

    def _accept(self) -> None:
        while True:
            with suppress(EOFError, OSError):  # the client has left, or has another key
                connection = self._listener.accept()
                Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection: Connection) -> None:
        with suppress(EOFError, OSError), connection:
            while True:
                name, arguments, more = pickle.loads(connection.recv_bytes())
                answer: tuple[Any, Exception | None]
                try:
                    with self._teacher._here():  # what it computes in its caller's thread is over
                        answer = getattr(self._teacher, name)(*arguments, **more), None
                except Exception as error:
                    answer = None, error
                connection.send_bytes(pickle.dumps(answer))
