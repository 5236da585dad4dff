// Reads the messages of schemas/*.proto, and the frames in which they come (see src/view/mod.rs).

const text = new TextDecoder();

/** Yields `{ topic, capture, arrival, payload }` of each frame; times are BigInt, nanoseconds. */
export function* frames(buffer) {
  const view = new DataView(buffer);
  let at = 0;
  while (at < buffer.byteLength) {
    const length = view.getUint32(at, true);
    const topic = text.decode(new Uint8Array(buffer, at + 4, length));
    at += 4 + length;
    const [capture, arrival] = [view.getBigInt64(at, true), view.getBigInt64(at + 8, true)];
    const size = view.getUint32(at + 16, true);
    yield { topic, capture, arrival, payload: new Uint8Array(buffer, at + 20, size) };
    at += 20 + size;
  }
}

const wireOf = { double: 1, fixed64: 1, sfixed64: 1, float: 5, fixed32: 5, sfixed32: 5, string: 2, bytes: 2, message: 2 };

/** Reads messages whose fields `schema` lists: by message and number, [name, type, message type, repeated]. */
export class Decoder {
  constructor(schema) {
    this.schema = schema;
  }

  /** The message of that name in `bytes`. Numbers of 64 bits are BigInt. */
  decode(name, bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    return this.message(name, view, 0, bytes.byteLength);
  }

  message(name, view, at, end) {
    const fields = this.schema[name];
    const out = {};
    for (const [field, , , repeated] of Object.values(fields)) if (repeated) out[field] = [];
    const cursor = { view, at };
    while (cursor.at < end) {
      const key = varint(cursor);
      const [field, type, of, repeated] = fields[key >> 3] ?? [];
      const wire = key & 7;
      const size = wire === 2 ? varint(cursor) : 0;
      if (!field) {
        skip(cursor, wire, size);
      } else if (wire === 2 && (wireOf[type] ?? 0) !== 2) {
        const until = cursor.at + size;
        while (cursor.at < until) out[field].push(number(cursor, type));
      } else {
        const value = wire === 2 ? this.block(cursor, type, of, size) : number(cursor, type);
        if (repeated) out[field].push(value);
        else out[field] = value;
      }
    }
    return out;
  }

  block(cursor, type, of, size) {
    const { view, at } = cursor;
    cursor.at += size;
    if (type === "message") return this.message(of, view, at, at + size);
    const bytes = new Uint8Array(view.buffer, view.byteOffset + at, size);
    return type === "string" ? text.decode(bytes) : bytes;
  }
}

/** A key or a length. */
function varint(cursor) {
  let value = 0;
  for (let place = 1; ; place *= 128) {
    const byte = cursor.view.getUint8(cursor.at++);
    value += (byte & 127) * place;
    if (byte < 128) return value;
  }
}

function varint64(cursor) {
  let value = 0n;
  for (let shift = 0n; ; shift += 7n) {
    const byte = cursor.view.getUint8(cursor.at++);
    value |= BigInt(byte & 127) << shift;
    if (byte < 128) return value;
  }
}

function number(cursor, type) {
  const { view, at } = cursor;
  const fixed = { 1: 8, 5: 4 }[wireOf[type]];
  if (fixed) {
    cursor.at += fixed;
    if (type === "double") return view.getFloat64(at, true);
    if (type === "float") return view.getFloat32(at, true);
    if (type === "fixed64") return view.getBigUint64(at, true);
    return type === "sfixed64" ? view.getBigInt64(at, true) : view.getInt32(at, true);
  }
  const value = varint64(cursor);
  if (type === "int64") return BigInt.asIntN(64, value);
  if (type === "uint64") return value;
  if (type === "sint64") return (value >> 1n) ^ -(value & 1n);
  if (type === "bool") return value !== 0n;
  if (type === "sint32") return Number((value >> 1n) ^ -(value & 1n));
  return Number(BigInt.asIntN(32, value));
}

function skip(cursor, wire, size) {
  if (wire === 0) varint(cursor);
  else cursor.at += { 1: 8, 2: size, 5: 4 }[wire];
}
