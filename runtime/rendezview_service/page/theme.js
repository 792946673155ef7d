// Light or dark: as the system has it, until the operator chooses.

const KEY = "rendezview-theme";
const system = matchMedia("(prefers-color-scheme: dark)");
const root = document.documentElement;
const shown = () => root.style.colorScheme || (system.matches ? "dark" : "light");

root.style.colorScheme = localStorage.getItem(KEY) ?? "";

/** A button that changes it; `changed()` draws what has its colours from the page. */
export function switchTheme(button, changed) {
  button.onclick = () => {
    root.style.colorScheme = shown() === "dark" ? "light" : "dark";
    localStorage.setItem(KEY, root.style.colorScheme);
    changed();
  };
  system.addEventListener("change", changed);
}
