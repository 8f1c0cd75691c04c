
addEventListener('load', () => {
  const since = document.getElementById('lost-since'), lost = document.body.classList;
  // The stand's clock, which the rest of the page shows; the viewer may be in another time zone.
  const ahead = new Date(since.dataset.clock) - Date.now();
  let heard = Date.now();
  const hear = () => { heard = Date.now(); };
  const lose = () => {
    if (!lost.contains('lost'))
      since.textContent = new Date(heard + ahead).toTimeString().slice(0, 8);
    lost.add('lost');
  };
  socket.onAny(hear);
  // The server's sign of life, every few seconds.
  socket.io.on('ping', hear);
  socket.on('connect', () => { hear(); lost.remove('lost'); });
  socket.on('disconnect', lose);
  socket.on('connect_error', lose);
});
