"use strict";

const HEARTBEAT = 50; // [ms] between two messages of the driver
const SOONEST = 20; // [ms] between two messages while a thumb moves
const DEAD_ZONE = 0.08; // of a pad's way, and of the tilt's
const WAY = 80; // [px] that a thumb moves for the whole steering
const TILT = Math.PI / 6; // [rad] for the whole steering
const SURE = 3000; // [ms] in which a second press quits
const FLASH = 800; // [ms] that a collision is seen
const KEYS = {
  ArrowLeft: "left", KeyA: "left", ArrowRight: "right", KeyD: "right",
  ArrowUp: "up", KeyW: "up", ArrowDown: "down", KeyS: "down",
};
const WISHES = { Space: "takeover", KeyP: "pause", KeyN: "skip", KeyQ: "quit", KeyC: "corridors", KeyG: "success", KeyF: "failure" };
const METERS = ["route", "confidence", "risk"]; // indicators with a bar
const BUTTONS = { 0: "takeover", 9: "pause", 8: "skip" }; // of a gamepad with the standard mapping
const ROLES = {
  driver: "You are at the wheel",
  taken: "Somebody else is at the wheel: you watch",
  free: "Nobody is at the wheel",
  spectator: "You watch",
};
const DRIVERS = { person: "A person drives", brake: "Nobody is at the wheel: the car brakes", novice: "The novice drives" };

const byId = (id) => document.getElementById(id);
const held = new Map(); // code of the key -> what it does
const pressed = new Set(); // buttons of the gamepad
const sentAt = new Map(); // number of a ping -> time
const touched = { steering: null, pedals: null }; // value of each pad, null while nobody touches it
let tilt = null; // steering, null if the phone does not tell
let role = "";
let pings = 0;
let toldAt = 0;
let collisions = null;
let asks = false; // whether the novice asks for help
let isAsked = false; // whether somebody asks the driver for the wheel
const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws${location.search}`);
socket.binaryType = "blob";

// Options, kept by the browser

const options = { pads: matchMedia("(any-pointer: coarse)").matches, tilt: false, vibration: true, sound: false };
let audio = null;

function keepOptions() {
  try {
    localStorage.setItem("cockpit", JSON.stringify(options));
  } catch { /* a browser that keeps nothing */ }
}

function readOptions() {
  try {
    const kept = JSON.parse(localStorage.getItem("cockpit"));
    for (const name in options) if (typeof kept?.[name] === "boolean") options[name] = kept[name];
  } catch { /* nothing was kept */ }
}

async function setOption(name, isOn) {
  options[name] = isOn;
  if (name === "tilt" && isOn && typeof DeviceOrientationEvent?.requestPermission === "function") {
    options.tilt = await DeviceOrientationEvent.requestPermission().catch(() => "denied") === "granted";
    byId("option-tilt").checked = options.tilt;
  }
  if (name === "sound" && isOn) beep();
  keepOptions();
  layout();
}

function beep(frequency = 220) {
  audio ??= new AudioContext();
  audio.resume();
  const [tone, volume] = [audio.createOscillator(), audio.createGain()];
  tone.frequency.value = frequency;
  volume.gain.setValueAtTime(0.3, audio.currentTime);
  volume.gain.exponentialRampToValueAtTime(0.001, audio.currentTime + 0.4);
  tone.connect(volume).connect(audio.destination);
  tone.start();
  tone.stop(audio.currentTime + 0.4);
}

readOptions();
for (const name in options) {
  const box = byId(`option-${name}`);
  box.checked = options[name];
  box.addEventListener("change", () => setOption(name, box.checked));
}

// The arrangement

function layout() {
  const [width, height] = [innerWidth, innerHeight];
  let name = "wide";
  if (width < height) name = "tall";
  else if (options.pads || height < 480 || width < 700 || (height < 620 && width >= 1.5 * height)) name = "low";
  else if (width < 1.5 * height) name = "square";
  document.body.dataset.layout = name;
  document.body.classList.toggle("pads", options.pads);
}

addEventListener("resize", layout);
layout();

// What the driver does

function send(message) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function clamp(value) {
  return Math.min(Math.max(value, -1), 1);
}

function beyondDeadZone(value) {
  return clamp(Math.sign(value) * Math.max(Math.abs(value) - DEAD_ZONE, 0) / (1 - DEAD_ZONE));
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

function touch() {
  if (touched.steering === null && touched.pedals === null) return null;
  return [touched.steering ?? (options.tilt && tilt !== null ? tilt : 0), touched.pedals ?? 0];
}

function tellHeld() {
  if (role === "driver" && document.hasFocus() && !document.hidden) {
    toldAt = performance.now();
    send({ keys: [...new Set(held.values())], gamepad: gamepad(), touch: touch() });
  }
}

function tellSoon() {
  if (performance.now() - toldAt >= SOONEST) tellHeld();
}

function ask(wish) {
  if (role === "driver") send({ wish });
}

function open(id) {
  const dialog = byId(id);
  if (dialog.open) dialog.close(); else dialog.showModal();
}

function leave() {
  held.clear();
  for (const name in touched) {
    touched[name] = null;
    byId(name).classList.remove("held");
  }
  if (role === "driver") send({ wish: "away" });
}

/** Whether the key belongs to the button that has the keyboard, as for those who use no mouse. */
function isForButton(event) {
  const focused = document.activeElement;
  return event.code === "Space" && focused?.matches("button:focus-visible, input:focus-visible");
}

addEventListener("keydown", (event) => {
  if (byId("form").open || event.ctrlKey || event.altKey || event.metaKey || isForButton(event)) return;
  if (event.code in KEYS) {
    held.set(event.code, KEYS[event.code]);
    if (!event.repeat) tellHeld();
  } else if (event.code in WISHES) {
    if (!event.repeat) ask(WISHES[event.code]);
  } else if (event.code === "KeyH") {
    if (!event.repeat) open("help");
  } else return;
  event.preventDefault();
});
addEventListener("keyup", (event) => {
  if (held.delete(event.code)) tellHeld();
});
addEventListener("blur", leave);
document.addEventListener("visibilitychange", () => { if (document.hidden) leave(); });

/** After a click Space is for takeovers again; who came by the keyboard stays where they are. */
function onClick(button, act) {
  button.addEventListener("click", (event) => {
    if (event.detail > 0) button.blur();
    act();
  });
}

let sureUntil = 0;

function quitTwice() {
  const quit = document.querySelector("[data-wish=quit]");
  if (performance.now() < sureUntil) {
    ask("quit");
    return;
  }
  sureUntil = performance.now() + SURE;
  quit.textContent = "Sure?";
  setTimeout(() => { quit.textContent = "Quit"; }, SURE);
}

for (const button of document.querySelectorAll("[data-wish]")) {
  const wish = button.dataset.wish;
  onClick(button, wish === "quit" ? quitTwice : () => ask(wish));
}
for (const button of document.querySelectorAll("[data-opens]")) onClick(button, () => open(button.dataset.opens));
onClick(byId("wheel"), () => send({ wish: role === "driver" ? "hand_over" : "wheel" }));
byId("corridors").addEventListener("change", () => ask("corridors"));
setInterval(tellHeld, HEARTBEAT);
setInterval(() => {
  sentAt.set(++pings, performance.now());
  send({ ping: pings });
}, 1000);

// Pads: one thumb each

function makePad(name, value) {
  const pad = byId(name);
  const knob = pad.querySelector(".knob");
  let pointer = null;
  let start = null;
  const move = (event) => {
    const box = pad.getBoundingClientRect();
    const place = { x: event.clientX - box.left, y: event.clientY - box.top };
    start ??= place;
    touched[name] = beyondDeadZone(value(place, start, box));
    knob.style.left = `${place.x}px`;
    knob.style.top = `${place.y}px`;
  };
  const end = (event) => {
    if (event.pointerId !== pointer) return;
    pointer = start = touched[name] = null;
    pad.classList.remove("held");
    tellHeld();
  };
  pad.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    if (pointer !== null || role !== "driver") return;
    pointer = event.pointerId;
    pad.setPointerCapture(pointer);
    pad.classList.add("held");
    move(event);
    tellHeld();
  });
  pad.addEventListener("pointermove", (event) => {
    if (event.pointerId !== pointer || touched[name] === null) return;
    move(event);
    tellSoon();
  });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(kind, end);
  // Else a Chromium, in wait of a gesture, lets messages of the server lie for 100 ms
  pad.addEventListener("touchstart", (event) => event.preventDefault(), { passive: false });
  pad.addEventListener("contextmenu", (event) => event.preventDefault());
}

// Steering from where the thumb came down, so that one need not look; pedals by their place
makePad("steering", (place, start, box) => (place.x - start.x) / Math.min(WAY, box.width / 2.5));
makePad("pedals", (place, start, box) => 1 - (2 * place.y) / box.height);

// How far the right side of the screen is lower than the left one
addEventListener("deviceorientation", ({ beta, gamma }) => {
  if (beta === null || gamma === null) return;
  const radians = Math.PI / 180;
  const [x, y] = [-Math.cos(beta * radians) * Math.sin(gamma * radians), Math.sin(beta * radians)]; // of the upward direction
  const right = { 0: x, 90: -y, 180: -x, 270: y }[screen.orientation?.angle ?? 0];
  tilt = beyondDeadZone(-Math.asin(clamp(right)) / TILT);
  if (options.tilt && touch() !== null) tellSoon();
});

// A phone that nobody touches goes dark, and the drive would pause
async function stayAwake() {
  try {
    if (!document.hidden) await navigator.wakeLock?.request("screen");
  } catch { /* not allowed: it goes dark */ }
}
document.addEventListener("visibilitychange", stayAwake);
stayAwake();

// What is shown

function bar(row, name) {
  const outer = document.createElement("div");
  outer.className = "bar";
  outer.setAttribute("role", "meter");
  outer.setAttribute("aria-label", `${row.firstElementChild.textContent}, ${name}`);
  outer.setAttribute("aria-valuemin", -1);
  outer.setAttribute("aria-valuemax", 1);
  outer.setAttribute("aria-valuenow", 0);
  const inner = document.createElement("div");
  const number = document.createElement("span");
  outer.append(inner, number);
  row.append(outer);
  return (value) => {
    const share = 50 * clamp(value);
    inner.style.left = `${50 + Math.min(share, 0)}%`;
    inner.style.width = `${Math.abs(share)}%`;
    outer.setAttribute("aria-valuenow", value.toFixed(2));
    setText(number, `${Math.round(100 * Math.abs(value))} %`);
    number.style.textAlign = value < 0 ? "right" : "left"; // in the half that is free
  };
}

const bars = {};
for (const name of ["proposed", "applied", "input"]) {
  bars[name] = [bar(byId(name), "steering, left to right"), bar(byId(name), "pedals, brake to throttle")];
}

function makeCell(name) {
  const cell = document.createElement("div");
  cell.className = "cell";
  const term = document.createElement("dt");
  term.textContent = name;
  const value = document.createElement("dd");
  value.id = `${name.replaceAll(" ", "-")}-value`;
  cell.append(term, value);
  if (METERS.includes(name)) {
    const meter = document.createElement("dd");
    meter.className = "meter";
    meter.id = `${name}-bar`;
    meter.append(document.createElement("div"));
    cell.append(meter);
  }
  return cell;
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function vibrate(pattern) {
  // Browsers refuse it until the page was touched
  if (options.vibration && navigator.userActivation?.hasBeenActive) navigator.vibrate?.(pattern);
}

function showQuery(isAsking) {
  if (isAsking && !asks) {
    vibrate([80, 60, 80]);
    if (options.sound) beep(660);
  }
  asks = isAsking;
  document.body.classList.toggle("asks", asks);
}

/** The button with which the wheel is taken, asked for and handed over. */
function showWheel(state) {
  const wheel = byId("wheel");
  const handOver = state.wants ? "Somebody asks for the wheel: hand back first" : "Somebody asks for the wheel: hand over";
  const texts = {
    free: "Take the wheel",
    taken: state.asking ? "You have asked for the wheel: ask no longer" : "Ask for the wheel",
    driver: state.is_asked ? handOver : "",
  };
  setText(wheel, texts[role] ?? "");
  wheel.hidden = !wheel.textContent;
  wheel.disabled = role === "driver" && state.wants;
  if (state.is_asked && !isAsked) {
    vibrate(120);
    if (options.sound) beep(440);
  }
  isAsked = state.is_asked;
  setText(byId("watching"), state.watching ? `${state.watching} watch` : "");
}

function showCollisions(number) {
  if (collisions !== null && number > collisions) {
    byId("view").classList.add("hit");
    setTimeout(() => byId("view").classList.remove("hit"), FLASH);
    vibrate(200);
    if (options.sound) beep();
  }
  collisions = number;
}

// Forms that the server asks to fill in

let formNumber = null; // of the form that is asked
let shownNumber = null; // of the form that is in the dialog

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

/** A scale has no value until the person has chosen one. */
function makeScale(question) {
  const input = element("input", { type: "range", min: 0, max: 100, step: 5, value: 50, name: question.name });
  const value = element("output", { textContent: "not chosen" });
  const [low, high] = question.ends;
  const choose = () => {
    input.dataset.chosen = "true";
    value.textContent = input.value;
    input.setAttribute("aria-valuetext", `${input.value} from ${low} to ${high}`);
  };
  input.setAttribute("aria-valuetext", "not chosen");
  for (const kind of ["input", "click"]) input.addEventListener(kind, choose);
  input.addEventListener("keydown", ({ code }) => { if (code === "Space" || code === "Enter") choose(); });
  const ends = element("span", { className: "ends" }, element("span", { textContent: low }), value, element("span", { textContent: high }));
  return element("label", { className: "question" }, element("span", { textContent: question.text }), input, ends);
}

function makeText(question) {
  const input = element("textarea", { name: question.name, rows: 3, maxLength: 4000 });
  return element("label", { className: "question" }, element("span", { textContent: question.text }), input);
}

async function answer(form, choice) {
  const fields = [...byId("form").querySelectorAll("input, textarea")];
  const missing = fields.find((field) => field.type === "range" && !field.dataset.chosen);
  const problem = byId("form").querySelector(".problem");
  if (missing) {
    problem.textContent = "Choose a place on each scale";
    missing.focus();
    return;
  }
  const values = Object.fromEntries(fields.map((field) => [field.name, field.type === "range" ? Number(field.value) : field.value]));
  const body = JSON.stringify({ form: form.number, choice, values });
  const response = await fetch(`/form${location.search}`, { method: "POST", body }).catch(() => null);
  problem.textContent = response?.ok ? "" : `Not stored${response ? `: ${await response.text()}` : ""}. Try again`;
}

async function showForm(number) {
  const dialog = byId("form");
  if (number === formNumber) {
    if (number !== null && number === shownNumber && !dialog.open) dialog.showModal(); // Escape does not end it
    return;
  }
  formNumber = number;
  dialog.close();
  if (number === null) return;
  const response = await fetch(`/form${location.search}`).catch(() => null);
  if (!response?.ok) {
    formNumber = null; // asked for again with the next state
    return;
  }
  const form = await response.json();
  if (form.number !== formNumber) return;
  leave();
  for (const other of document.querySelectorAll("dialog[open]")) other.close();
  byId("form-title").textContent = form.title;
  const questions = form.questions.map((question) => (question.ends ? makeScale(question) : makeText(question)));
  const buttons = form.choices.map((choice) => {
    const button = element("button", { type: "button", textContent: choice });
    button.addEventListener("click", () => answer(form, choice));
    return button;
  });
  const text = element("p", { className: "reading", textContent: form.text });
  const problem = element("p", { className: "problem" });
  problem.setAttribute("role", "alert");
  shownNumber = number;
  byId("fields").replaceChildren(text, ...questions, problem, ...buttons);
  dialog.showModal();
  dialog.scrollTop = 0;
}

byId("fields").addEventListener("input", () => { byId("form").querySelector(".problem").textContent = ""; });
byId("form").addEventListener("cancel", (event) => event.preventDefault());

function show(state) {
  role = state.role;
  showForm(state.form);
  document.body.dataset.driver = state.driver;
  const told = state.driver === "person" && role === "driver" ? "You drive" : DRIVERS[state.driver];
  const wheelToo = state.is_asked ? `${told}. Somebody asks for the wheel` : told;
  setText(byId("told"), state.asks ? "The novice asks for help" : wheelToo);
  setText(byId("role"), ROLES[role]);
  showWheel(state);
  byId("notice").hidden = !state.notice;
  setText(byId("notice"), state.notice);
  byId("notice").classList.toggle("waits", state.waits);
  const list = byId("indicators");
  if (list.childElementCount !== state.indicators.length) list.replaceChildren(...state.indicators.map(([name]) => makeCell(name)));
  for (const [name, value] of state.indicators) setText(byId(`${name.replaceAll(" ", "-")}-value`), value);
  for (const name of METERS) {
    byId(`${name}-bar`).hidden = state[name] === null;
    byId(`${name}-bar`).firstElementChild.style.width = `${100 * (state[name] ?? 0)}%`;
  }
  showQuery(state.asks);
  byId("corridors").disabled = role !== "driver" || state.corridors === null;
  byId("corridors").checked = state.corridors === true;
  for (const name of Object.keys(bars)) bars[name].forEach((set, i) => set(state[name][i]));
  for (const button of document.querySelectorAll("[data-wish]")) button.disabled = role !== "driver";
  const mayDrive = role === "driver" && state.may_take_over;
  document.querySelector("[data-wish=takeover]").disabled = !mayDrive;
  for (const name in touched) byId(name).classList.toggle("off", !mayDrive);
  setText(document.querySelector("[data-wish=takeover]"), state.wants ? "Hand back" : "Take over");
  setText(document.querySelector("[data-wish=pause]"), state.paused ? "Begin" : "Pause");
  showCollisions(state.collisions);
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
socket.addEventListener("close", ({ code, reason }) => {
  showForm(null);
  role = "";
  document.body.dataset.driver = "unknown";
  byId("wheel").hidden = true;
  byId("notice").hidden = false;
  const lost = `Not connected${reason ? `: ${reason}` : ""}. Reload the page to connect again`;
  byId("notice").textContent = code === 1001 && reason ? reason : lost; // it went away in good order
  byId("connection").textContent = "";
});
