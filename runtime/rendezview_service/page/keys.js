// The keyboard: keys that no control uses.

/** Calls the action of a key with its event; letters in either case. */
export function listen(keys) {
  document.addEventListener("keydown", (event) => {
    const { target, key } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (target.matches("select, input[type=password]")) return;
    if (key === " " && target.matches("button, input[type=checkbox]")) return; // these use the space key
    const act = keys[key.length === 1 ? key.toLowerCase() : key];
    if (!act) return;
    event.preventDefault();
    act(event);
  });
}
