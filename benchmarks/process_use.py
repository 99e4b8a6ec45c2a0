"""What a process has used so far."""

import os
from pathlib import Path
from typing import Literal


def cpu_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int, kind: Literal["RssAnon", "VmRSS"] = "RssAnon") -> float:
    """Resident memory of a process: what it alone has (``RssAnon``), or with mapped files (``VmRSS``)."""
    status = Path(f"/proc/{pid}/status").read_text()
    return next(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith(f"{kind}:"))
