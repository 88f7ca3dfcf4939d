"""Write what mediapipe's own runtime finds on crops of the portrait: `python tools/record_mediapipe.py`.

Needs `pip install mediapipe==0.10.14` beside the project; the tests compare `uika.photo.networks` with the file.
"""

from __future__ import annotations

from pathlib import Path

import mediapipe
import numpy as np
from PIL import Image

from tests.photo.crops import portrait_crops

TARGET = Path(__file__).resolve().parent.parent / "tests" / "photo" / "mediapipe.npz"


def main() -> None:
    crops, recorded = portrait_crops(), {}
    solutions = mediapipe.solutions
    for index, crop in enumerate(crops):
        boxes = []
        for reach in (1, 0):
            with solutions.face_detection.FaceDetection(0.5, model_selection=reach) as detector:
                for detection in detector.process(crop).detections or ():
                    box = detection.location_data.relative_bounding_box
                    boxes.append((box.xmin, box.ymin, box.width, box.height))
        recorded[f"boxes_{index}"] = np.array(boxes, dtype=np.float64).reshape(-1, 4) * len(crop)
        with solutions.face_mesh.FaceMesh(static_image_mode=True, refine_landmarks=True, max_num_faces=4) as mesh:
            faces = mesh.process(crop).multi_face_landmarks or ()
            points = [[(point.x, point.y) for point in face.landmark] for face in faces]
            recorded[f"faces_{index}"] = np.array(points, dtype=np.float64).reshape(-1, 478, 2) * len(crop)
    with solutions.selfie_segmentation.SelfieSegmentation(model_selection=0) as model:
        mask = model.process(crops[0]).segmentation_mask
    recorded["mask"] = np.asarray(Image.fromarray(mask).resize((64, 64), Image.Resampling.BOX))
    with solutions.face_mesh.FaceMesh(refine_landmarks=True, max_num_faces=1) as mesh:
        mesh.process(np.zeros((64, 64, 3), dtype=np.uint8))
        followed = [mesh.process(crop).multi_face_landmarks for crop in crops[:2]]
    recorded["followed"] = np.array([[(p.x, p.y) for p in face[0].landmark] for face in followed]) * len(crops[0])
    np.savez_compressed(TARGET, **recorded)
    print(f"wrote {TARGET}: {TARGET.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
