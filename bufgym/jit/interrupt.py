"""Long work in kernels that answers Ctrl-C."""

import threading
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def interruptible(work: Callable[[], Result]) -> Result:
    """Run ``work()``, which may spend minutes in kernels, and still answer Ctrl-C at once.

    Python handles a signal only in its main thread, between two of its own instructions. So the main thread waits (60
    us) while another works. After a KeyboardInterrupt the other goes on until its kernel or the process ends.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    from concurrent.futures import Future, wait  # not at start-up: it imports logging, and most work is short

    future: Future[Result] = Future()

    def carry_out() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # to be raised in the waiting thread
            future.set_exception(error)

    threading.Thread(target=carry_out, daemon=True).start()
    while not future.done():
        wait([future], 0.5)  # on Windows a signal does not end a wait; half a second does
    return future.result()
