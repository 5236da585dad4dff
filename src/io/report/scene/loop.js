// The stretch of a take that is repeated.

/** What a press on the loop button does next, by the number of ends that are set. */
export const NEXT = ["Loop from here", "Loop to here", "End loop"];

/**
 * The ends of the stretch, seconds, after a press at a time: one, two, or `undefined` again. Two presses at one place:
 * two seconds around it.
 */
export function press(loop, time, last) {
  if (loop === undefined) return [time];
  if (loop.length === 2) return undefined;
  const [from, to] = [Math.min(loop[0], time), Math.max(loop[0], time)];
  return to - from > 0.1 ? [from, to] : [Math.max(0, time - 1), Math.min(last, time + 1)];
}

/** The time to show: the beginning of the stretch, if playing leaves it. */
export const inLoop = (loop, time) => (loop?.length === 2 && (time < loop[0] || time > loop[1]) ? loop[0] : time);
