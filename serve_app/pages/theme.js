// The colour scheme that was chosen here, before anything is painted: by default the system's.
// A classic script, for modules run after the first paint.
const chosen = localStorage.getItem("theme");
if (chosen) document.documentElement.dataset.theme = chosen;
