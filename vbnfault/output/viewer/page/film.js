// Play the frames of a sequence one after the other, at the pace of their times.
import { $ } from "/elements.js";

const SPEEDS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 100, 1000, 10000]; // times real time
const AHEAD = 3; // frames that are read before they are due

// Return a player of sequences. `names` has theirs, `times()` sequence and time of every sample, `order()` the samples that
// pass the filters, or null. `show` shows a sample and waits until it is drawn, `ahead` begins to read one, `paused` is
// called at each stop.
export function player({ names, times, order, show, ahead, paused }) {
  const film = { frames: [], at: 0, playing: false, turn: 0, moved, play, pause };
  const speed = $("speed"), time = (index) => times().time_s[index];
  let sequence = -2, passing = null, stepS = 0;

  // Return the samples of a sample's sequence that pass the filters, or all; the same array until another is asked for.
  function framesOf(index) {
    const { sequence: all } = times(), passed = order();
    if (all[index] === sequence && passed === passing && film.frames.includes(index)) return film.frames;
    [sequence, passing] = [all[index], passed];
    const of = (samples) => [...samples].filter((i) => all[i] === sequence);
    const frames = of(passed ?? all.keys());
    return frames.includes(index) ? frames : of(all.keys());
  }

  // Show where a sample is in its sequence.
  function moved(index) {
    const frames = framesOf(index);
    if (frames !== film.frames) {
      film.frames = frames;
      stepS = (time(frames.at(-1)) - time(frames[0])) / Math.max(1, frames.length - 1);
      $("frame").max = frames.length - 1;
      if (!speed.value) choose(SPEEDS.find((factor) => factor >= 1 && stepS / factor <= 1) ?? SPEEDS.at(-1));
    }
    film.at = Math.max(0, frames.indexOf(index));
    $("frame").value = film.at;
    const digits = stepS > 0 ? Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(stepS)))) : 1;
    $("time").textContent = `${time(index).toFixed(digits).replace("-", "−")} s`;
    $("sequence").textContent = `${names[sequence] ?? ""}, frame ${film.at + 1} of ${frames.length}`;
    $("film").hidden = false;
  }

  function choose(factor) {
    speed.replaceChildren(...SPEEDS.map((one) => new Option(`× ${one}`, one, false, one === factor)));
  }

  function state(playing) {
    film.playing = playing;
    $("play").firstChild.textContent = playing ? "pause" : "play";
    $("play").setAttribute("aria-pressed", String(playing));
  }

  async function play() {
    const turn = ++film.turn;
    state(true);
    if (film.at + 1 >= film.frames.length) await show(film.frames[0]);
    let due = performance.now();
    while (turn === film.turn && film.at + 1 < film.frames.length) {
      const here = film.frames[film.at], next = film.frames[film.at + 1];
      film.frames.slice(film.at + 1, film.at + 1 + AHEAD).forEach(ahead);
      due = Math.max(due + (1000 * (time(next) - time(here))) / Number(speed.value), performance.now());
      await new Promise((done) => setTimeout(done, due - performance.now()));
      if (turn === film.turn) await show(next);
    }
    if (turn === film.turn) pause();
  }

  function pause() {
    if (!film.playing) return;
    film.turn++;
    state(false);
    paused();
  }

  $("play").addEventListener("click", () => (film.playing ? pause() : play()));
  $("frame").addEventListener("input", () => { pause(); show(film.frames[Number($("frame").value)]); });
  speed.addEventListener("change", () => { if (film.playing) play(); });
  return film;
}
