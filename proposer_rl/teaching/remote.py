"""Clients of a teacher in other processes, and the threads that answer them."""

from __future__ import annotations

import os
import pickle
from contextlib import suppress
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener
from threading import Lock, Thread
from typing import Any


class TeacherClient:
    """Calls a teacher that is in another process; :meth:`Teacher.client` makes one to send there.

    The order in which several processes ask is not fixed, so such runs cannot be repeated exactly.
    """

    def __init__(self, address: Any, key: bytes, required_results: tuple[str, ...]) -> None:
        self._address, self._key = address, key
        self.required_results = required_results
        self._connection: Connection | None = None
        self._process = 0
        self._lock = Lock()

    def ask(self, n: int | None = None) -> tuple[Any, Any]:
        """Returns the next levels and their tickets, as :meth:`Teacher.ask` does."""
        return self._call("ask", n)

    def tell(self, ids: Any, return_: Any, success: Any = None, **more: Any) -> None:
        """Takes the results of levels, as :meth:`Teacher.tell` does."""
        self._call("tell", ids, return_, success, **more)

    def drop(self, ids: Any = None) -> None:
        """Gives up levels, as :meth:`Teacher.drop` does."""
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
            except (AuthenticationError, EOFError, OSError) as lost:
                raise RuntimeError("the process of the teacher has ended") from lost
        if error is not None:
            raise error
        return result


class TeacherServer:
    """Answers a teacher's clients, from threads of this process."""

    def __init__(self, teacher: Any) -> None:
        self._teacher, self._key = teacher, os.urandom(32)
        try:
            self._listener = Listener(authkey=self._key)
        except OSError:  # as where TMPDIR is too long for a socket's path
            self._listener = Listener(("127.0.0.1", 0), authkey=self._key)
        Thread(target=self._accept, daemon=True).start()

    def client(self) -> TeacherClient:
        """Returns a new client."""
        return TeacherClient(self._listener.address, self._key, self._teacher.required_results)

    def _accept(self) -> None:
        while True:
            with suppress(EOFError, OSError):  # of a client that has left or has another key
                connection = self._listener.accept()
                Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection: Connection) -> None:
        with suppress(EOFError, OSError), connection:
            while True:
                name, arguments, more = pickle.loads(connection.recv_bytes())
                answer: tuple[Any, Exception | None]
                try:
                    with self._teacher._here():  # waits for calls of other threads
                        answer = getattr(self._teacher, name)(*arguments, **more), None
                except Exception as error:
                    answer = None, error
                connection.send_bytes(pickle.dumps(answer))
