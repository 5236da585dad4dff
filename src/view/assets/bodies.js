// Fetches the skins of the performers.

import { metres } from "./body.js";

/** A skeleton that is learned changes often; its skin is fetched at most as often as this, milliseconds. */
const PAUSE = 1000;

/** Gives each performer whose skeleton is new its skin: `{ rest, offsets }`. */
export async function fetchSkins(store) {
  for (const one of store.performers.values()) {
    const { skeleton } = one;
    if (!skeleton || one.skinOf === skeleton || performance.now() < (one.skinWanted ?? 0)) continue;
    [one.skinOf, one.skinWanted] = [skeleton, performance.now() + PAUSE];
    const offsets = skeleton.rest_offsets_m;
    const answer = await fetch(`rest?offsets=${offsets.map((x) => x.toFixed(6))}`).catch(() => undefined);
    if (answer?.ok) one.skin = { rest: metres(new Int16Array(await answer.arrayBuffer())), offsets };
    else one.skinOf = undefined;
  }
}
