"""Write the policy that plays in a page of the documentation as JSON.

python docs/make_play.py
"""

import base64
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import mtjax

RUN = "point-mass-vary-goal/sac-conditioned"
FILE = Path(__file__).parent / "play" / "policy.json"


def exported(run: str) -> dict[str, Any]:
    """Return a policy as ``mtjax.export`` writes it: its program, and constants as 32-bit floats in base64."""
    with tempfile.TemporaryDirectory() as folder, np.load(mtjax.export(mtjax.load(run), f"{folder}/p.npz")) as file:
        program = json.loads(bytes(file["program"]))
        constants = [file[f"constant_{i}"] for i in range(program["constants"])]
    encode = lambda x: base64.b64encode(np.asarray(x, "<f4").tobytes()).decode()
    return {"program": program, "constants": [{"shape": x.shape, "floats": encode(x)} for x in constants]}


if __name__ == "__main__":
    FILE.write_text(json.dumps(exported(RUN), separators=(",", ":")) + "\n")
    print(f"{FILE}: {FILE.stat().st_size:,} bytes")
