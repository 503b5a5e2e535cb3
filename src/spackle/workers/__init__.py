"""Photos shared by processes, here or on a Ray cluster: each sets up once, and results come as they are made."""

from spackle.workers.local import PhotoWorker, Workers, threads_of_torch
from spackle.workers.ray import at_work, cluster

__all__ = ["PhotoWorker", "Workers", "at_work", "cluster", "threads_of_torch"]
