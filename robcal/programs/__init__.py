"""Programs of robot controllers, corrected in place: KUKA KRL, ABB RAPID, URScript, Fanuc TP (LS)."""
