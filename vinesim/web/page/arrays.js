// Messages of named arrays: see vinesim/web/array_message.py for their layout.

const KINDS = {
  u1: Uint8Array,
  i1: Int8Array,
  u2: Uint16Array,
  i2: Int16Array,
  u4: Uint32Array,
  i4: Int32Array,
  f4: Float32Array,
  f8: Float64Array,
};

/** Returns the header of a message; its `arrays` are typed arrays over the message's own memory. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  for (const [name, [kind, shape, offset]] of Object.entries(header.arrays)) {
    header.arrays[name] = new KINDS[kind](
      buffer,
      4 + length + offset,
      shape.reduce((product, n) => product * n, 1),
    );
  }
  return header;
}

/** Loads the message at a path of this server. */
export async function load(path) {
  const response = await fetch(path);
  if (!response.ok) throw Object.assign(new Error(`${path}: ${await response.text()}`), { status: response.status });
  return decode(await response.arrayBuffer());
}

/** Returns the address of the web socket at a path below the page's address, which holds the secret of the page. */
export function socketAddress(path) {
  const address = new URL(path, location);
  address.protocol = address.protocol.replace("http", "ws");
  return address.href;
}
