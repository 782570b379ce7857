-- 1 if the deployment has failed and its fallback runs, else 0.
ALTER TABLE reported ADD COLUMN on_fallback BIGINT NOT NULL DEFAULT 0;
