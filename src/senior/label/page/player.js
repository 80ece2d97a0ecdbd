// Two clips played as one: the same start, the same frame, the same loop; and a pool of the pairs that come next.

const REST = 400; // ms that the last frame stays before both clips begin again, so that the loop is seen as one
const PATIENCE = 600; // ms that a clip may take to load before it is asked to play
const stillness = matchMedia("(prefers-reduced-motion: reduce)");

/** A hidden <video> that loads the clip; `drawn` is called when its first frame is ready for the screen. */
function makeVideo(url, screen, drawn) {
  const video = document.createElement("video");
  video.muted = true;
  video.setAttribute("muted", "");
  video.playsInline = true;
  video.disableRemotePlayback = true;
  video.preload = "auto";
  video.tabIndex = -1;
  let failures = 0;
  video.addEventListener("error", () => {
    setTimeout(() => video.isConnected && video.load(), Math.min(500 * 2 ** failures++, 5000));
  });
  if ("requestVideoFrameCallback" in video) video.requestVideoFrameCallback(drawn);
  else video.addEventListener("canplay", drawn, { once: true });
  video.src = url;
  screen.append(video);
  return video;
}

/** Gives the decoder and the connection back at once: browsers limit how many of them a page may hold. */
function dropVideo(video) {
  video.pause();
  video.remove();
  video.removeAttribute("src");
  video.load();
}

const keyOf = (pair) => `${pair.pair} ${pair.left} ${pair.right}`;
const hasClips = (pair) => Boolean(pair?.left && pair?.right);

/** Whether the clip can play: it has data ahead, or all of it (WebKit may not say the first after a seek). */
function ready(video) {
  const { readyState, seeking, buffered, duration } = video;
  if (seeking || readyState < HTMLMediaElement.HAVE_CURRENT_DATA) return false;
  const whole = buffered.length > 0 && buffered.end(buffered.length - 1) > duration - 0.1;
  return whole || readyState >= HTMLMediaElement.HAVE_FUTURE_DATA;
}

/**
 * `screens` are the elements {left, right} that hold the videos. `hooks` are called with what changes: shown() when
 * both clips of a newly opened pair are on the screen and play, frame(k), playing(yes), trouble(yes) while a clip
 * cannot be loaded, shape(width / height).
 */
export function createPlayer(screens, hooks) {
  const pool = new Map();
  let current = null; // {pair, videos, drawn: how many first frames are there, seen: whether shown() was called}
  let wanted = false; // whether it should play, be it loading or not
  let rate = 1;
  let loops = 0;
  let restedSince = null;
  let ticking = false;
  let running = false; // both were started together; else they are being gathered
  let gatheredSince = 0;
  const said = { trouble: false }; // what each hook was last called with

  function tell(hook, value) {
    if (said[hook] === value) return;
    said[hook] = value;
    hooks[hook](value);
  }

  function load(pair) {
    if (!pool.has(keyOf(pair))) {
      const entry = { pair, drawn: 0, seen: false };
      entry.videos = ["left", "right"].map((side) => makeVideo(pair[side], screens[side], () => (entry.drawn += 1)));
      pool.set(keyOf(pair), entry);
    }
    return pool.get(keyOf(pair));
  }

  /** Keeps the clips of these pairs and loads those that are missing; lets all others go. */
  function prefetch(pairs) {
    const kept = pairs.filter(hasClips);
    const keys = new Set(kept.map(keyOf));
    for (const [name, entry] of pool) {
      if (keys.has(name) || entry === current) continue;
      entry.videos.forEach(dropVideo);
      pool.delete(name);
    }
    kept.forEach(load);
  }

  /** Puts a pair on the screens from its first frame on, or clears them (null). Says whether it was loaded already. */
  function open(pair) {
    current?.videos.forEach((video) => {
      video.pause();
      video.removeAttribute("id");
      video.classList.remove("on");
    });
    current = hasClips(pair) ? load(pair) : null;
    loops = 0;
    restedSince = null;
    delete said.frame;
    tell("trouble", false);
    wanted = current !== null && !document.hidden;
    if (!current) {
      tell("playing", false);
      return false;
    }
    hold();
    const loaded = current.videos.every(ready);
    current.seen = false;
    current.videos.forEach((video, side) => {
      video.id = ["video-left", "video-right"][side];
      video.classList.add("on");
      if (video.currentTime > 0) video.currentTime = 0;
    });
    run();
    return loaded;
  }

  function run() {
    if (!ticking && current && wanted) {
      ticking = true;
      tick();
    }
    tell("playing", wanted);
  }

  /** Once a screen refresh: starts, holds, aligns and loops both clips by looking at where they are. */
  function tick() {
    ticking = Boolean(current && wanted);
    if (!ticking) return;
    const { videos } = current;
    tell("trouble", videos.some((video) => video.error));
    if (videos.every((video) => video.ended)) rest();
    else if (running) align();
    else gather();
    tell("frame", frame());
    if (!current.seen) look();
    requestAnimationFrame(tick);
  }

  /** Shown: first frames were made beforehand, both clocks run, and the screen is painted right after this tick. */
  function look() {
    const [one, other] = current.videos;
    if (one.videoWidth) tell("shape", one.videoWidth / one.videoHeight);
    if (current.drawn < 2 || one.currentTime === 0 || other.currentTime === 0) return;
    current.seen = true;
    hooks.shown();
  }

  /** Waits until both clips can play, and starts them in one go. iOS loads nothing before it is asked to play. */
  function gather() {
    const { videos } = current;
    running = videos.every(ready);
    for (const video of videos) {
      if (video.error) continue;
      if (running || (!ready(video) && performance.now() - gatheredSince > PATIENCE)) start(video);
      else if (ready(video)) video.pause();
    }
  }

  /** The clip that is behind runs a little faster; if it stands still, both stop and start anew from where it is. */
  function align() {
    const { videos, pair } = current;
    const [one, other] = videos;
    const gap = (one.currentTime - other.currentTime) * pair.fps; // frames
    const apart = Math.abs(gap) > 3 && !one.ended && !other.ended;
    if (apart || videos.some((video) => video.error || (video.paused && !video.ended))) {
      hold();
      if (apart) (gap > 0 ? one : other).currentTime = Math.min(one.currentTime, other.currentTime);
      return;
    }
    videos.forEach((video, side) => {
      const late = side === 0 ? -gap : gap;
      const pull = video.playbackRate > rate ? late > 0.05 : late > 0.4;
      const wish = pull ? rate * 1.15 : rate;
      if (video.playbackRate !== wish) video.playbackRate = wish; // some browsers seek at each change
    });
  }

  /** Both stand still until they can start together. */
  function hold() {
    running = false;
    gatheredSince = performance.now();
    for (const video of current.videos) video.pause();
  }

  function rest() {
    if (stillness.matches) {
      pause();
      return;
    }
    restedSince ??= performance.now();
    if (performance.now() - restedSince >= REST) rewind();
  }

  function rewind() {
    hold();
    restedSince = null;
    loops += 1;
    for (const video of current.videos) video.currentTime = 0;
  }

  function start(video) {
    video.play().catch((problem) => {
      if (problem.name === "NotAllowedError") pause(); // no autoplay here: the person has to press play once
    });
  }

  function pause() {
    wanted = false;
    if (current) hold();
    run();
  }

  function play() {
    if (!current) return;
    if (current.videos.every((video) => video.ended)) rewind();
    wanted = true;
    run();
  }

  function frame() {
    const { pair, videos } = current;
    return Math.min(pair.frames - 1, Math.floor(videos[0].currentTime * pair.fps + 0.01));
  }

  /** Shows frame k of both clips, standing still. The middle of its time is where no rounding shows a neighbour. */
  function seek(k) {
    if (!current) return;
    pause();
    const to = Math.max(0, Math.min(current.pair.frames - 1, k));
    for (const video of current.videos) video.currentTime = (to + 0.5) / current.pair.fps;
    tell("frame", to);
  }

  return {
    open,
    prefetch,
    play,
    pause,
    setRate: (value) => (rate = value),
    seek,
    toggle: () => (wanted ? seek(frame()) : play()), // a pause shows the same frame of both
    step: (frames) => current && seek(frame() + frames),
    isPlaying: () => wanted,
    loops: () => loops,
  };
}
