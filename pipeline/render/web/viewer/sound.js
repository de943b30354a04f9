/* Sound. While it plays, the audio element's clock is the viewer's clock: the figures follow what is heard. */

const PATIENCE = 1; // seconds that the figures wait for sound to start, before they go on without

/* `changed()` after sound went on or off; `stopped()` when someone outside the page pauses it, a headset's key say. */
function makePlayer(sounds, { changed, stopped }) {
  const player = { on: false, failed: false, audio: null };
  const made = new Map();
  let length = 0, speed = 1, volume = 1, last = null, waited = 0, starting = false;

  player.choose = (number) => {
    const next = number === undefined ? null : made.get(number) || openSound(sounds[number]);
    if (next === player.audio) return;
    player.rest();
    if (next) made.set(number, next);
    player.audio = next;
    length = next ? sounds[number].seconds : 0;
  };
  const openSound = (raw) => {
    const audio = new Audio();
    audio.preload = "auto";
    audio.addEventListener("error", () => { player.failed = true; player.turn(false); });
    audio.src = URL.createObjectURL(new Blob([bytesOf(raw.data)], { type: raw.mime }));
    return audio;
  };
  player.turn = (on) => {
    player.on = on && !player.failed;
    if (!player.on) player.rest();
    changed();
  };
  player.setSpeed = (value) => { speed = value; };
  player.setVolume = (value) => { volume = value; };
  /* Silence until `advance` is called again. */
  player.rest = () => {
    if (player.audio && !player.audio.paused) player.audio.pause();
    starting = false;
    last = null;
  };
  /* Silence at once; the viewer's time where the sound stopped, which may have gone on since the last drawing. */
  player.halt = (time) => {
    const { audio } = player;
    const heard = audio && !audio.paused && !audio.seeking && !starting && time === last;
    player.rest();
    return heard ? audio.currentTime : time;
  };

  const begin = (place) => {
    const { audio } = player;
    audio.currentTime = place;
    starting = true;
    waited = 0;
    audio.play().then(() => { starting = false; }, (error) => {
      starting = false;
      if (error.name === "NotAllowedError") player.turn(false); // the browser wants a gesture first
    });
  };
  /* The viewer's time after `passed` seconds of the wall clock, by the sound where there is one to hear. */
  player.advance = (time, passed) => {
    const { audio } = player;
    if (!player.on || !audio || time >= length - 0.02) {
      player.rest();
      return time + passed * speed;
    }
    audio.defaultPlaybackRate = audio.playbackRate = speed;
    audio.volume = volume;
    if (time !== last) { // someone went elsewhere
      begin(time);
      last = time;
      return time;
    }
    if (starting || audio.seeking || audio.readyState < 3) {
      waited += passed;
      if (waited < PATIENCE) return time;
    }
    if (audio.paused && !audio.ended && !starting) {
      player.rest();
      stopped();
      return time;
    }
    if (audio.ended || starting || audio.seeking) {
      last = time + passed * speed;
      return last;
    }
    // Some browsers move their audio clock in steps: go on evenly, pulled towards it, and never 15 ms away.
    const heard = audio.currentTime, even = time + passed * speed;
    last = clamp(even + 0.2 * (heard - even), heard - 0.015, heard + 0.015);
    return last;
  };
  return player;
}
