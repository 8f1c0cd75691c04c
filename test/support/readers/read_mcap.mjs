// Print the messages of an mcap file as JSON, by topic: node read_mcap.mjs FILE
import { readFileSync } from 'node:fs';
import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { McapIndexedReader } from '@mcap/core';
import { loadDecompressHandlers } from '@mcap/support';

const content = readFileSync(process.argv[2]);
const readable = {
  size: async () => BigInt(content.length),
  read: async (offset, size) => content.subarray(Number(offset), Number(offset + size)),
};
const decompressHandlers = await loadDecompressHandlers();
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const decoders = new Map();
const found = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  if (!decoders.has(channel.id)) {
    const schema = reader.schemasById.get(channel.schemaId);
    const definitions = parse(new TextDecoder().decode(schema.data), { ros2: true });
    decoders.set(channel.id, new MessageReader(definitions));
  }
  const decoded = decoders.get(channel.id).readMessage(message.data);
  (found[channel.topic] ??= []).push({ log: String(message.logTime), decoded });
}
const plain = (_, value) =>
  typeof value === 'bigint' ? String(value) : ArrayBuffer.isView(value) ? [...value] : value;
console.log(JSON.stringify(found, plain));
