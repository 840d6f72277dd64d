"""Batches of rows on threads: array operations release the interpreter, and rows are independent.

What is computed for a batch depends on the batch alone, so the number of threads changes no byte.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Batch = TypeVar("Batch")


def batches(n: int, size: int = 32) -> list[slice]:
    """Rows by a few, so that what is computed of them stays in the cache."""
    return [slice(i, min(i + size, n)) for i in range(0, n, size)]


def over(parts: Iterable[Batch], work: Callable[[Batch], None]) -> None:
    """Call `work` with every part, on as many threads as there are processors; one part, here."""
    parts = list(parts)
    if len(parts) < 2:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 1) as pool:
        for _ in pool.map(work, parts):
            pass
