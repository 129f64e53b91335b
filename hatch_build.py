"""Build hook: compiles protocols/geometry/kernels.c where there is a C compiler; else the wheel is pure Python."""

from __future__ import annotations

import os
import shutil
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# No fused operations: the same numbers on every machine.
FLAGS = ("-O3", "-fPIC", "-shared", "-ffp-contract=off", "-fno-math-errno")


class KernelsBuildHook(BuildHookInterface[Any]):
    """Adds the compiled kernels to a wheel, which is then of this machine's platform."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; what fails leaves the wheel as it would be without."""
        source = Path(self.root) / "protocols" / "geometry" / "kernels.c"
        library = source.with_name("libkernels.so")
        compiler = shutil.which(os.environ.get("CC", "cc"))
        if self.target_name != "wheel" or compiler is None or os.environ.get("SYNCLINE_PURE"):
            return
        command = [compiler, *FLAGS, "-o", str(library), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            self.app.display_warning(f"kernels not compiled, numpy is used: {done.stderr.strip()[-500:]}")
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
        build_data["artifacts"].append("protocols/geometry/libkernels.so")
