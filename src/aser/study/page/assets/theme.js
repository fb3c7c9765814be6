// Light or dark: as the system says, until the button was pressed. Charts listen to "theme".
"use strict";

const theme = {
  dark() {
    const chosen = document.documentElement.dataset.theme;
    return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  },
  set(name) {
    document.documentElement.dataset.theme = name;
    try {
      localStorage.setItem("theme", name);
    } catch {
      // A browser may keep nothing for pages from the disk. The choice then lasts for this page.
    }
  },
};

try {
  const kept = localStorage.getItem("theme");
  if (kept) document.documentElement.dataset.theme = kept;
} catch {
  // As above.
}

document.addEventListener("DOMContentLoaded", () => {
  const button = document.getElementById("theme");
  const show = () => {
    button.textContent = theme.dark() ? "Light" : "Dark";
    button.setAttribute("aria-pressed", String(theme.dark()));
    document.dispatchEvent(new Event("theme"));
  };
  button.addEventListener("click", () => {
    theme.set(theme.dark() ? "light" : "dark");
    show();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
  show();
});
