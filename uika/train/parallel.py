"""Several processes: torchrun's environment, DDP, FSDP2 and what all processes must agree on."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import torch
import torch.distributed as dist
from torch import nn

from uika.errors import UikaError

Sharding = Literal["ddp", "fsdp"]


@dataclass(frozen=True)
class Group:
    """This process among all; device is where it computes."""

    rank: int
    size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.rank == 0

    def any(self, flag: bool) -> bool:
        """Whether the flag is set anywhere."""
        if self.size == 1:
            return flag
        value = torch.tensor(float(flag), device=self.device)
        dist.all_reduce(value, dist.ReduceOp.MAX)
        return bool(value)

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Means over the processes; all must bring the same names."""
        if self.size == 1:
            return values
        table = torch.tensor(list(values.values()), dtype=torch.float64, device=self.device)
        dist.all_reduce(table)
        return dict(zip(values, (table / self.size).tolist(), strict=True))

    def shared(self, value: int) -> int:
        """The first process's value."""
        if self.size == 1:
            return value
        holder = torch.tensor(value, device=self.device)
        dist.broadcast(holder, 0)
        return int(holder)

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            dist.barrier()


def join_group(device: str = "auto") -> Group:
    """Join the processes that torchrun started; alone without it.

    Args:
        device: "auto", "cpu" or "cuda".

    Raises:
        UikaError: CUDA is asked for but not there.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise UikaError(f"device must be auto, cpu or cuda, not '{device}'")
    if device == "cuda" and not torch.cuda.is_available():
        raise UikaError("device cuda: this torch sees no CUDA device; use --device cpu")
    cuda = device != "cpu" and torch.cuda.is_available()
    size, local = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("LOCAL_RANK", 0))
    chosen = torch.device("cuda", local) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(chosen)
    if size > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if cuda else "gloo")
    return Group(dist.get_rank() if size > 1 else 0, size, chosen)


def leave_group() -> None:
    """End the communication, if there was any."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def distribute(network: nn.Module, blocks: list[nn.Module], group: Group, sharding: Sharding) -> nn.Module:
    """The network as all processes train it: replicated (ddp), or its parameters cut up among them (fsdp)."""
    if group.size == 1:
        return network
    if sharding == "fsdp":
        from torch.distributed.fsdp import fully_shard

        trained = [block for block in blocks if any(p.requires_grad for p in block.parameters())]
        for block in trained:
            fully_shard(block)
        fully_shard(network)
        return network
    from torch.nn.parallel import DistributedDataParallel

    devices = [group.device.index] if group.device.type == "cuda" else None
    return DistributedDataParallel(network, device_ids=devices)
