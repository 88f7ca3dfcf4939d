"""VRM 1.0: the rigged mesh as an avatar of the programs that take VRM, with expressions, bones and terms of use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uika.avatar import Avatar
from uika.export.mesh import SkinnedMesh, skinned_mesh
from uika.export.rigged import MESH_NODE, add_mesh
from uika.export.texture import SIZE, bake_texture
from uika.head import HeadModel
from uika.io.files import check_output
from uika.io.glb import Glb
from uika.motion.vrm_expressions import PRESETS, actions_of

EXTENSION = "VRMC_vrm"
_LICENCE = "https://vrm.dev/licenses/1.0/"  # what the specification demands here
# Our joint -> bone. The root turns about the base of the neck, the joint "neck" below the skull.
_OWN_BONES = {"neck": 0, "head": 1, "jaw": 2, "leftEye": 3, "rightEye": 4}
# Bones that VRM demands of a body that is not there: name -> parent, metres from it (X is the subject's left).
_BODY: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "hips": (None, (0.0, 0.95, 0.0)),
    "spine": ("hips", (0.0, 0.15, 0.0)),
    "leftUpperLeg": ("hips", (0.09, -0.05, 0.0)),
    "leftLowerLeg": ("leftUpperLeg", (0.0, -0.42, 0.0)),
    "leftFoot": ("leftLowerLeg", (0.0, -0.42, 0.0)),
    "rightUpperLeg": ("hips", (-0.09, -0.05, 0.0)),
    "rightLowerLeg": ("rightUpperLeg", (0.0, -0.42, 0.0)),
    "rightFoot": ("rightLowerLeg", (0.0, -0.42, 0.0)),
    "leftUpperArm": ("spine", (0.17, 0.3, 0.0)),
    "leftLowerArm": ("leftUpperArm", (0.27, 0.0, 0.0)),
    "leftHand": ("leftLowerArm", (0.25, 0.0, 0.0)),
    "rightUpperArm": ("spine", (-0.17, 0.3, 0.0)),
    "rightLowerArm": ("rightUpperArm", (-0.27, 0.0, 0.0)),
    "rightHand": ("rightLowerArm", (-0.25, 0.0, 0.0)),
}
_NECK = (0.0, 0.38, 0.0)  # of the head's root from the spine


def write_vrm(path: str | Path, avatar: Avatar, head: HeadModel, name: str = "avatar", size: int = SIZE) -> SkinnedMesh:
    """Write a head as VRM 1.0: it stands where a grown person's head is, on bones of a body without a mesh.

    The terms of use are the narrowest that VRM knows: only the person who made it may use it, unchanged and not for
    money; the provenance says of whom it was made.

    Args:
        path: `.vrm` file.
        avatar: the avatar.
        head: the head model that it was made for.
        name: what programs call the avatar.
        size: side of each texture in texels.

    Returns:
        The mesh that was written.

    Raises:
        UikaError: wrong extension, nothing can be written there, or the head model is another one.
    """
    check_output(path, ".vrm")
    mesh = skinned_mesh(avatar, head)
    file = Glb(avatar.provenance)
    add_mesh(file, mesh, [bake_texture(avatar, head, tile, size) for tile in mesh.faces])
    bones = {**_OWN_BONES, **_add_body(file)}
    expressions = {
        "preset": _expressions(mesh, {name: actions_of(name, mesh.morphs) for name in PRESETS}),
        "custom": _expressions(mesh, {m: {m: 1.0} for m in mesh.morphs}),
    }
    file.document["extensions"] = {
        EXTENSION: {
            "specVersion": "1.0",
            "meta": _meta(name, avatar),
            "humanoid": {"humanBones": {bone: {"node": node} for bone, node in bones.items()}},
            "expressions": expressions,
            "lookAt": {"type": "expression", "offsetFromHeadBone": [0.0, 0.06, 0.06], **_LOOK},
        }
    }
    file.document["extensionsUsed"].append(EXTENSION)
    file.write(path, ".vrm")
    return mesh


_RANGE = {"inputMaxValue": 90.0, "outputScale": 1.0}
_LOOK = {f"rangeMap{way}": _RANGE for way in ("HorizontalInner", "HorizontalOuter", "VerticalDown", "VerticalUp")}


def _add_body(file: Glb) -> dict[str, int]:
    """Nodes of the body; the head's root becomes a child of the spine."""
    nodes: list[dict[str, Any]] = file.document["nodes"]
    places = {name: len(nodes) + number for number, name in enumerate(_BODY)}
    for name, (_, place) in _BODY.items():
        children = [places[child] for child, (parent, _) in _BODY.items() if parent == name]
        children += [0] if name == "spine" else []
        node: dict[str, Any] = {"name": name, "translation": list(place)}
        nodes.append({**node, "children": children} if children else node)
    nodes[0]["translation"] = list(_NECK)
    file.document["scenes"] = [{"nodes": [places["hips"], MESH_NODE]}]
    return places


def _expressions(mesh: SkinnedMesh, wanted: dict[str, dict[str, float]]) -> dict[str, Any]:
    """VRM's expressions of those that the mesh has morph targets for."""
    order, found = list(mesh.morphs), {}
    for name, actions in wanted.items():
        binds = [
            {"node": MESH_NODE, "index": order.index(action), "weight": weight} for action, weight in actions.items()
        ]
        if binds:
            found[name] = {"morphTargetBinds": binds, "isBinary": False}
    return found


def _meta(name: str, avatar: Avatar) -> dict[str, Any]:
    consent = avatar.provenance.get("consent", "not stated")
    return {
        "name": name,
        "authors": [avatar.provenance.get("program", "uika-drjit")],
        "copyrightInformation": f"Made from photos; consent of the person shown: {consent}",
        "licenseUrl": _LICENCE,
        "avatarPermission": "onlyAuthor",
        "commercialUsage": "personalNonProfit",
        "creditNotation": "required",
        "modification": "prohibited",
        "allowRedistribution": False,
        "allowExcessivelyViolentUsage": False,
        "allowExcessivelySexualUsage": False,
        "allowPoliticalOrReligiousUsage": False,
        "allowAntisocialOrHateUsage": False,
    }
