"""Describe the hardware on which a run was timed: processor, cores and memory.

A name such as "AMD EPYC" may stand for several generations of processors, so family, model and stepping are recorded
too. The module does not import torch.
"""

import math
import os
import platform
from dataclasses import dataclass
from pathlib import Path

from gsbench.process.memory import lines_of

CPUINFO = Path("/proc/cpuinfo")
MEMINFO = Path("/proc/meminfo")
# Keys of /proc/cpuinfo, on x86-64 and on aarch64.
_KEYS = {
    "family": ("cpu family", "CPU implementer"),
    "model": ("model", "CPU part"),
    "stepping": ("stepping", "CPU revision"),
}


@dataclass(frozen=True)
class Hardware:
    """The processor and the memory of a machine; values that the system does not report are None."""

    processor: str  # its name
    cores: int | None  # all cores of the system, even if this run may not use all of them
    memory_gib: int | None  # rounded up, because the system reserves some memory at boot
    family: str | None = None
    model: str | None = None
    stepping: str | None = None
    instruction_set: str | None = None  # the one that the CPU kernels used, such as "v3"; None if they are not built

    def __str__(self) -> str:
        kind = [f"{name} {value}" for name in _KEYS if (value := getattr(self, name)) is not None]
        facts = [" ".join([self.processor, *kind])]
        facts += [f"{self.cores} core{'' if self.cores == 1 else 's'}"] if self.cores is not None else []
        facts += [self.instruction_set] if self.instruction_set is not None else []
        facts += [f"{self.memory_gib} GiB"] if self.memory_gib is not None else []
        return ", ".join(facts)


def named(device: str, threads: int, hardware: Hardware | None) -> str:
    """Return a description of a machine; times of two runs are comparable only if their descriptions are equal."""
    where = "" if hardware is None or device == hardware.processor else f"{device} in "
    return f"{where}{hardware or device}, {threads} thread{'' if threads == 1 else 's'}"


def hardware(instruction_set: str | None = None) -> Hardware:
    """Return the processor and memory of this machine; `instruction_set` is that of the CPU kernels."""
    facts = _facts(CPUINFO)
    kind = {name: next((facts[key] for key in keys if key in facts), None) for name, keys in _KEYS.items()}
    kilobytes = _facts(MEMINFO).get("MemTotal", "").partition(" ")[0]
    memory = math.ceil(int(kilobytes) / 2**20) if kilobytes.isdecimal() else None
    return Hardware(processor_name(), os.cpu_count(), memory, **kind, instruction_set=instruction_set)


def processor_name() -> str:
    """Return the processor's name, such as "AMD EPYC 9B14"."""
    return _facts(CPUINFO).get("model name") or platform.processor() or platform.machine()


def _facts(path: Path) -> dict[str, str]:
    """Return the first value of each key in a file of lines `key : value`, such as /proc/cpuinfo; {} without it."""
    pairs = (line.partition(":") for line in reversed(lines_of(path)))
    return {key.strip(): value.strip() for key, _, value in pairs}
