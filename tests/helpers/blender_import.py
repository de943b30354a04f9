"""Run by Blender's Python: imports a file into an empty scene and writes what is there as JSON.

blender_import.py FILE FPS FRAMES OUT: the positions of all bones in `FRAMES` frames, the body at rest, the
actions, the shape keys. Nothing of motionloom is imported.
"""

import json
import sys
from pathlib import Path

import bpy


def bones(figure: object) -> dict[str, list[float]]:
    return {bone.name: list(figure.matrix_world @ bone.head) for bone in figure.pose.bones}


def main() -> None:
    path, fps, frames, out = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = fps
    if path.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=path)
    else:
        bpy.ops.import_anim.bvh(filepath=path, global_scale=0.01, update_scene_fps=True)
    (figure,) = [one for one in bpy.data.objects if one.type == "ARMATURE"]
    meshes = [one for one in bpy.data.objects if one.type == "MESH" and one.parent == figure]
    found = {
        "fps": scene.render.fps / scene.render.fps_base,
        "actions": {one.name: list(one.frame_range) for one in bpy.data.actions},
        "meshes": {one.name: len(one.vertex_groups) for one in meshes},
        "shapes": {
            one.name: [key.name for key in one.data.shape_keys.key_blocks]
            for one in meshes
            if one.data.shape_keys
        },
        "rest": [list(one.matrix_world @ vertex.co) for one in meshes for vertex in one.data.vertices],
    }
    begin = int(found["actions"][figure.animation_data.action.name][0])
    found["playing"], found["bones"] = figure.animation_data.action.name, []
    for frame in range(frames):
        scene.frame_set(begin + frame)
        found["bones"].append(bones(figure))
    Path(out).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
