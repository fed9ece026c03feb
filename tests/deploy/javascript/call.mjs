// node call.mjs MODULE FUNCTION < arguments as JSON: prints what a module's function returns; bytes are {"base64": ...}, a Float32Array {"float32": ...}.
import { readFileSync } from "node:fs";
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";

const [module, name] = process.argv.slice(2);
const revive = (_, value) => {
  if (value?.float32) return Float32Array.from(value.float32);
  if (value?.base64 === undefined) return value;
  const bytes = Buffer.from(value.base64, "base64");
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
};
const plain = (_, value) => (ArrayBuffer.isView(value) ? Array.from(value) : value);
const calls = JSON.parse(readFileSync(0, "utf8"), revive);
const functions = await import(pathToFileURL(resolve(module)));
const answer = (given) => {
  try {
    return { result: functions[name](...given) };
  } catch (error) {
    return { error: error.message };
  }
};
console.log(JSON.stringify(calls.map(answer), plain));
