// node call.mjs MODULE FUNCTION < arguments as JSON: prints what a module's function returns; bytes are {"base64": ...}, those of a Float32Array {"float32": ...}.
import { readFileSync } from "node:fs";
import { resolve } from "node:path";
import { pathToFileURL } from "node:url";

const [module, name] = process.argv.slice(2);
const revive = (_, value) => {
  const text = value?.base64 ?? value?.float32;
  if (text === undefined) return value;
  const bytes = Uint8Array.from(Buffer.from(text, "base64")).buffer;
  return value.float32 === undefined ? bytes : new Float32Array(bytes);
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
