"use strict";

const HEARTBEAT = 50; // [ms] between two messages of the driver
const KEYS = {
  ArrowLeft: "left", KeyA: "left", ArrowRight: "right", KeyD: "right",
  ArrowUp: "up", KeyW: "up", ArrowDown: "down", KeyS: "down",
};
const WISHES = { Space: "takeover", KeyP: "pause", KeyN: "skip", KeyQ: "quit", KeyH: "help" };
const BUTTONS = { 0: "takeover", 9: "pause", 8: "skip" }; // of a gamepad with the standard mapping
const ROLES = {
  driver: "You are at the wheel",
  taken: "Somebody else is at the wheel: you watch",
  free: "Nobody is at the wheel",
  spectator: "You watch",
};

const byId = (id) => document.getElementById(id);
const held = new Map(); // code of the key -> what it does
const pressed = new Set(); // buttons of the gamepad
const sentAt = new Map(); // number of a ping -> time
let role = "";
let pings = 0;
const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws${location.search}`);
socket.binaryType = "blob";

// What the driver does

function send(message) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function clamp(value) {
  return Math.min(Math.max(value, -1), 1);
}

function gamepad() {
  const pad = navigator.getGamepads().find((candidate) => candidate && candidate.mapping === "standard");
  if (!pad) return null;
  for (const [number, wish] of Object.entries(BUTTONS)) {
    const down = pad.buttons[number].pressed;
    if (down && !pressed.has(number)) ask(wish);
    if (down) pressed.add(number); else pressed.delete(number);
  }
  return [clamp(pad.axes[0]), clamp(pad.buttons[7].value), clamp(pad.buttons[6].value)];
}

function tellHeld() {
  if (role === "driver" && document.hasFocus() && !document.hidden) {
    send({ keys: [...new Set(held.values())], gamepad: gamepad() });
  }
}

function ask(wish) {
  if (wish === "help") byId("help").hidden = !byId("help").hidden;
  else if (role === "driver") send({ wish });
  if (wish === "pause") byId("help").hidden = true;
}

function leave() {
  held.clear();
  if (role === "driver") send({ wish: "away" });
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.code in KEYS) {
    held.set(event.code, KEYS[event.code]);
    if (!event.repeat) tellHeld();
  } else if (event.code in WISHES) {
    if (!event.repeat) ask(WISHES[event.code]);
  } else return;
  event.preventDefault();
});
addEventListener("keyup", (event) => {
  if (held.delete(event.code)) tellHeld();
});
addEventListener("blur", leave);
document.addEventListener("visibilitychange", () => { if (document.hidden) leave(); });
for (const button of document.querySelectorAll("[data-wish]")) {
  button.addEventListener("click", () => {
    button.blur(); // Space is for takeovers
    ask(button.dataset.wish);
  });
}
byId("wheel").addEventListener("click", () => {
  byId("wheel").blur();
  send({ wish: "wheel" });
});
setInterval(tellHeld, HEARTBEAT);
setInterval(() => {
  sentAt.set(++pings, performance.now());
  send({ ping: pings });
}, 1000);

// What is shown

function bar(row, low, high) {
  const end = (text, name) => {
    const label = document.createElement("span");
    label.className = `end ${name}`;
    label.textContent = text;
    row.append(label);
  };
  end(low, "low");
  const outer = document.createElement("div");
  outer.className = "bar";
  const inner = document.createElement("div");
  outer.append(inner);
  row.append(outer);
  end(high, "high");
  return (value) => {
    const share = 50 * clamp(value);
    inner.style.left = `${50 + Math.min(share, 0)}%`;
    inner.style.width = `${Math.abs(share)}%`;
  };
}

const bars = {};
for (const name of ["proposed", "applied", "input"]) {
  bars[name] = [bar(byId(name), "left", "right"), bar(byId(name), "brake", "throttle")];
}

function show(state) {
  role = state.role;
  document.body.classList.toggle("takeover", state.takeover);
  byId("role").textContent = ROLES[role];
  byId("wheel").hidden = role !== "free";
  byId("notice").hidden = !state.notice;
  byId("notice").textContent = state.notice;
  byId("notice").classList.toggle("waits", state.waits);
  const list = byId("indicators");
  if (list.childElementCount !== 2 * state.indicators.length) {
    list.replaceChildren(...state.indicators.flatMap(([name]) => {
      const value = document.createElement("dd");
      value.id = `${name.replaceAll(" ", "-")}-value`;
      const term = document.createElement("dt");
      term.textContent = name;
      return [term, value];
    }));
  }
  for (const [name, value] of state.indicators) byId(`${name.replaceAll(" ", "-")}-value`).textContent = value;
  byId("confidence").hidden = state.confidence === null;
  byId("confidence").firstElementChild.style.width = `${100 * (state.confidence ?? 0)}%`;
  byId("applied").querySelector("span").textContent = state.takeover ? "the driver's" : "the novice's";
  for (const name of Object.keys(bars)) bars[name].forEach((set, i) => set(state[name][i]));
  for (const button of document.querySelectorAll("[data-wish]:not([data-wish=help])")) button.disabled = role !== "driver";
  document.querySelector("[data-wish=takeover]").textContent = state.wants ? "Hand back" : "Take over";
}

async function draw(blob) {
  const image = await createImageBitmap(blob);
  const canvas = byId("picture");
  if (canvas.width !== image.width || canvas.height !== image.height) {
    [canvas.width, canvas.height] = [image.width, image.height];
  }
  canvas.getContext("2d").drawImage(image, 0, 0);
  image.close();
}

socket.addEventListener("message", ({ data }) => {
  if (data instanceof Blob) {
    draw(data);
    return;
  }
  const message = JSON.parse(data);
  if ("pong" in message) {
    const roundTrip = performance.now() - sentAt.get(message.pong);
    sentAt.delete(message.pong);
    byId("connection").textContent = `round trip ${roundTrip.toFixed(0)} ms`;
  } else show(message);
});
socket.addEventListener("close", ({ reason }) => {
  role = "";
  byId("notice").hidden = false;
  byId("notice").textContent = `Not connected${reason ? `: ${reason}` : ""}. Reload the page to connect again`;
  byId("connection").textContent = "";
});
