// Fetches the skins of the performers.

import { metres } from "./body.js";

/** A skeleton that is learned changes often; its skin is fetched at most as often as this, milliseconds. */
const PAUSE = 1000;

/** Gives each performer whose body is new its skin: `{ rest, offsets }`. */
export async function fetchSkins(store) {
  for (const one of store.performers.values()) {
    const offsets = one.skeleton?.rest_offsets_m;
    const text = offsets?.map((x) => x.toFixed(6)).join();
    if (!text || one.skinOf === text || performance.now() < (one.skinWanted ?? 0)) continue;
    [one.skinOf, one.skinWanted] = [text, performance.now() + PAUSE];
    try {
      const answer = await fetch(`rest?offsets=${text}`);
      if (!answer.ok) throw new Error(answer.statusText);
      const rest = metres(new Int16Array(await answer.arrayBuffer()));
      if (one.skinOf === text) one.skin = { rest, offsets };
    } catch {
      if (one.skinOf === text) one.skinOf = undefined;
    }
  }
}
