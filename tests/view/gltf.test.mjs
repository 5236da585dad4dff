// Khronos' validator finds nothing wrong with the glTF files of `bundlemocap export`.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import validator from "gltf-validator";
import { folder, root, run } from "./browser.mjs";

test("glTF files are valid", async () => {
  run("synth", "--performers", "2", "--out", join(folder, "two.mcap"));
  const takes = [
    [[join(root, "recordings/walk.mcap")], ["take.glb"]],
    [[join(folder, "two.mcap"), "--performers", "auto"], ["take.p1.glb", "take.p2.glb"]],
  ];
  for (const [solved, files] of takes) {
    run("solve", ...solved, "--out", join(folder, "out"), "--overwrite");
    const plain = files.map((file) => [file, []]);
    const other = ["--rest", "a", "--axes", "world", "--names", "mixamo", "--fps", "30"];
    for (const [file, options] of [...plain, ...files.map((file) => [file, other])]) {
      run("export", join(folder, "out/poses.mcap"), "--out", join(folder, "take.glb"), "--overwrite", ...options);
      const { issues, info } = await validator.validateBytes(new Uint8Array(readFileSync(join(folder, file))));
      assert.deepEqual(issues.messages, [], file);
      assert.deepEqual([info.animationCount, info.hasSkins, info.totalTriangleCount], [1, true, 13432]);
    }
  }
});
