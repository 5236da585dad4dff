// The colours of performers and cameras.

export const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442"];

/** A colour that colour-blind people can tell from the others [Okabe 2008]; after these paler ones, then darker ones. */
export function colour(index) {
  const own = COLOURS[index % COLOURS.length];
  const round = Math.floor(index / COLOURS.length) % 3;
  if (round === 0) return own;
  const towards = round === 1 ? 255 : 0;
  const half = (digits) => Math.round((parseInt(digits, 16) + towards) / 2).toString(16).padStart(2, "0");
  return own.replace(/[0-9a-f]{2}/g, half);
}

/** The number of a performer's colour: by names such as p7, so that it is the same everywhere; or else `other`. */
export const numberOf = (name, other) => (/^p[1-9]\d*$/.test(name) ? Number(name.slice(1)) - 1 : other);
