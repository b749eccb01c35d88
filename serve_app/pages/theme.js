// Apply the stored theme before the first paint. A classic script, because modules run after it.
const theme = localStorage.getItem("theme");
if (theme) document.documentElement.dataset.theme = theme;
