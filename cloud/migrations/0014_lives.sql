-- Lives of streams, which earlier versions have stored up to the largest number of the database:
-- the next one must fit.
UPDATE streams SET life = 4611686018427387904 WHERE life > 4611686018427387904;
