// The colours of performers and cameras.

const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#8a8f98"];

/** A colour that colour-blind people can tell from the others [Okabe 2008]. */
export const colour = (index) => COLOURS[index % COLOURS.length];
