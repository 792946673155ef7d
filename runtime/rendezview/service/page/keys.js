// The keyboard: what is pressed where nothing else wants it.

/** Calls what stands for a key, with its event; letters of either case. */
export function listen(keys) {
  document.addEventListener("keydown", (event) => {
    const { target, key } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (target.matches("select, input[type=password]")) return;
    if (key === " " && target.matches("button, input[type=checkbox]")) return; // they have it themselves
    const act = keys[key.length === 1 ? key.toLowerCase() : key];
    if (!act) return;
    event.preventDefault();
    act(event);
  });
}
