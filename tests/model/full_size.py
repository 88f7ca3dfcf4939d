"""One photo through a released file, in its own process: `python -m tests.model.full_size FILE float32|bfloat16`."""

import json
import resource
import sys
import time

import torch

from uika.model import released


def main(path: str, dtype: str) -> None:
    start = time.perf_counter()
    model = released.load(path, dtype=getattr(torch, dtype))
    loaded = time.perf_counter()
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(1, 1, 3, 512, 512, generator=generator)
    masks = torch.zeros(1, 1, 1, 512, 512)
    masks[..., 60:450, 100:400] = 1
    result = model(images, masks)
    done = time.perf_counter()
    figures = {
        "load_s": loaded - start,
        "run_s": done - loaded,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "gaussians": result.means.shape[1],
        "finite": all(bool(torch.isfinite(part).all()) for part in result),
        "spread": result.offsets.std().item(),
        "unused": len(model.unused),
        "sample": [part.flatten()[::5000][:20].tolist() for part in result],
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main(*sys.argv[1:])
