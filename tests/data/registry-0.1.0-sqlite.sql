BEGIN TRANSACTION;
CREATE TABLE acknowledgements (
	replica VARCHAR(255) NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	version INTEGER, 
	sha256 VARCHAR(64), 
	fault TEXT, 
	aliases JSON NOT NULL, 
	traffic INTEGER, 
	event INTEGER, 
	seen_at DATETIME NOT NULL, 
	CONSTRAINT pk_acknowledgements PRIMARY KEY (replica, league), 
	CONSTRAINT fk_acknowledgements_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "acknowledgements" VALUES('replica-2','tictactoe',1,'0000000000000000000000000000000000000000000000000000000000000000','it is loading','{"champion": 1}',1,3,'2026-11-26 23:11:12.902782');
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO "alembic_version" VALUES('0001');
CREATE TABLE alias_events (
	id INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	alias VARCHAR(255) NOT NULL, 
	kind VARCHAR(16) NOT NULL, 
	version INTEGER NOT NULL, 
	previous INTEGER, 
	beneath INTEGER, 
	actor TEXT NOT NULL, 
	reason TEXT NOT NULL, 
	verdict VARCHAR(255), 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_alias_events PRIMARY KEY (id), 
	CONSTRAINT fk_alias_events_beneath FOREIGN KEY(beneath) REFERENCES alias_events (id), 
	CONSTRAINT fk_alias_events_league_version FOREIGN KEY(league, version) REFERENCES versions (league, number), 
	CONSTRAINT fk_alias_events_verdict FOREIGN KEY(verdict) REFERENCES verdicts (id)
);
INSERT INTO "alias_events" VALUES(1,'tictactoe','champion','set',1,NULL,NULL,'ada','the first',NULL,'2026-11-26 23:11:12.312714');
INSERT INTO "alias_events" VALUES(2,'tictactoe','champion','set',2,1,1,'league nightly','better','tictactoe-verdict-0123456789abcdef0123456789abcdef','2026-11-26 23:11:12.587671');
INSERT INTO "alias_events" VALUES(3,'tictactoe','champion','rollback',1,2,NULL,'ada','too slow',NULL,'2026-11-26 23:11:12.615230');
INSERT INTO "alias_events" VALUES(4,'tictactoe','candidate','set',2,NULL,NULL,'ada','again',NULL,'2026-11-26 23:11:12.624158');
CREATE TABLE aliases (
	league VARCHAR(255) NOT NULL, 
	name VARCHAR(255) NOT NULL, 
	version INTEGER NOT NULL, 
	event INTEGER NOT NULL, 
	CONSTRAINT pk_aliases PRIMARY KEY (league, name), 
	CONSTRAINT fk_aliases_event FOREIGN KEY(event) REFERENCES alias_events (id), 
	CONSTRAINT fk_aliases_league_version FOREIGN KEY(league, version) REFERENCES versions (league, number)
);
INSERT INTO "aliases" VALUES('tictactoe','champion',1,3);
INSERT INTO "aliases" VALUES('tictactoe','candidate',2,4);
CREATE TABLE api_keys (
	id VARCHAR(8) NOT NULL, 
	name VARCHAR(255) NOT NULL, 
	sha256 VARCHAR(64) NOT NULL, 
	scopes JSON NOT NULL, 
	leagues JSON, 
	rate DOUBLE, 
	created_at DATETIME NOT NULL, 
	expires_at DATETIME, 
	revoked_at DATETIME, 
	CONSTRAINT pk_api_keys PRIMARY KEY (id), 
	CONSTRAINT uq_api_keys_name UNIQUE (name), 
	CONSTRAINT uq_api_keys_sha256 UNIQUE (sha256)
);
INSERT INTO "api_keys" VALUES('4f9b6777','ci','d8fe290630e3e5ec2c39de4f4fd361d1ce33ea4dbfd55635e9e5bc76bdcaabf7','["promote", "read"]','["tictactoe"]',20.0,'2026-11-26 23:11:12.253661',NULL,NULL);
CREATE TABLE change_counter (
	id INTEGER NOT NULL, 
	aliases BIGINT DEFAULT '0' NOT NULL, 
	traffic BIGINT DEFAULT '0' NOT NULL, 
	keys BIGINT DEFAULT '0' NOT NULL, 
	leagues BIGINT DEFAULT '0' NOT NULL, 
	CONSTRAINT pk_change_counter PRIMARY KEY (id)
);
INSERT INTO "change_counter" VALUES(1,4,1,1,1);
CREATE TABLE earlier_games (
	league VARCHAR(255) NOT NULL, 
	digest VARCHAR(64) NOT NULL, 
	game JSON NOT NULL, 
	replaced_at DATETIME NOT NULL, 
	CONSTRAINT pk_earlier_games PRIMARY KEY (league, digest), 
	CONSTRAINT fk_earlier_games_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "earlier_games" VALUES('tictactoe','218f0e9a7309a1f13f6728e985622a170587fb68bd68cdb14cc04e3e106df647','{"environment": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832", "environment.source": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855", "gymnasium": "1.2.2", "numpy": "2.4.6", "pettingzoo": "1.27.0", "play.opening_plies": 4, "play.scoring": null, "play.max_moves": 10000}','2026-11-26 23:11:11.822025');
CREATE TABLE evaluations (
	id INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	request JSON NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	progress JSON, 
	result JSON, 
	error JSON, 
	actor TEXT NOT NULL, 
	"key" VARCHAR(8), 
	reason TEXT, 
	workers INTEGER, 
	runner VARCHAR(64), 
	attempts INTEGER NOT NULL, 
	created_at DATETIME NOT NULL, 
	started_at DATETIME, 
	heartbeat_at DATETIME, 
	stop_at DATETIME, 
	stopped_by TEXT, 
	ended_at DATETIME, 
	CONSTRAINT pk_evaluations PRIMARY KEY (id), 
	CONSTRAINT fk_evaluations_key FOREIGN KEY("key") REFERENCES api_keys (id), 
	CONSTRAINT fk_evaluations_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "evaluations" VALUES(1,'tictactoe','{"kind": "tournament", "blocks": 2}','done','{"what": "games", "played": 1, "of": 4}','{"matches": 4}',NULL,'ci','4f9b6777','why not',2,'runner',0,'2026-11-26 23:11:12.698469','2026-11-26 23:11:12.706918','2026-11-26 23:11:12.720404',NULL,NULL,'2026-11-26 23:11:12.738976');
CREATE TABLE idempotent_calls (
	owner VARCHAR(8) NOT NULL, 
	"key" VARCHAR(255) NOT NULL, 
	digest VARCHAR(64) NOT NULL, 
	event INTEGER, 
	traffic INTEGER, 
	evaluation INTEGER, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_idempotent_calls PRIMARY KEY (owner, "key"), 
	CONSTRAINT fk_idempotent_calls_evaluation FOREIGN KEY(evaluation) REFERENCES evaluations (id), 
	CONSTRAINT fk_idempotent_calls_event FOREIGN KEY(event) REFERENCES alias_events (id), 
	CONSTRAINT fk_idempotent_calls_owner FOREIGN KEY(owner) REFERENCES api_keys (id), 
	CONSTRAINT fk_idempotent_calls_traffic FOREIGN KEY(traffic) REFERENCES traffic_events (id)
);
INSERT INTO "idempotent_calls" VALUES('4f9b6777','a','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa',1,NULL,NULL,'2026-11-26 23:11:12.288135');
INSERT INTO "idempotent_calls" VALUES('4f9b6777','b','bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',NULL,1,NULL,'2026-11-26 23:11:12.659104');
INSERT INTO "idempotent_calls" VALUES('4f9b6777','c','cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc',NULL,NULL,1,'2026-11-26 23:11:12.687683');
CREATE TABLE leagues (
	slug VARCHAR(255) NOT NULL, 
	config JSON NOT NULL, 
	interface JSON NOT NULL, 
	interface_digest VARCHAR(64) NOT NULL, 
	environment_digest VARCHAR(64) NOT NULL, 
	game JSON NOT NULL, 
	game_digest VARCHAR(64) NOT NULL, 
	last_version INTEGER NOT NULL, 
	registered_at DATETIME NOT NULL, 
	archived_at DATETIME, 
	CONSTRAINT pk_leagues PRIMARY KEY (slug)
);
INSERT INTO "leagues" VALUES('tictactoe','{"league": "tictactoe", "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3", "api": null, "kwargs": {}, "wrappers": [], "vector": null, "revision": null}, "folder": null, "policies": null, "sides": null, "play": {"opening_plies": 0, "actions": null, "scoring": null, "num_envs": "auto", "max_moves": 10000, "game_seconds": 600.0, "action_names": null}, "training": {"seed": 0, "steps": null, "minutes": null, "checkpoint_every": "auto", "checkpoint_minutes": null, "runners": 1, "num_envs": "auto", "gamma": 0.99, "grad_clip": 0.5, "convolutions": [], "channels": null, "hidden": [256, 256], "normalize_observations": false, "policies_to_train": null, "opponents": {"fixed": [], "league": null}, "exploiter": {}, "strength": {"games": 200}, "gpus": 0.0, "runner_gpus": 0.0, "crashes": 3, "opening_plies": null, "algorithm": "ppo", "lr": 0.0005, "train_batch_size": 4096, "minibatch_size": 512, "epochs": 4, "lambda": 0.95, "clip": 0.2, "entropy": 0.05, "value_loss": 0.5, "magnet": null, "teacher": null, "recurrence": null, "shared_encoder": false, "per_policy": {}}, "gate": {"model": "normalized", "elo0": 0.0, "elo1": 30.0, "return0": 0.0, "return1": 0.0, "return_bound": null, "alpha": 0.05, "nights": 365, "beta": 0.05, "max_blocks": 4000, "anchors": [], "earlier_champions": 2, "margin": 50.0, "exploited_champions": 2, "exploiter_margin": null, "exploiters": {"count": 0, "budget": 0.15, "blocks": 200, "improvement": 0.0}, "confirmation_blocks": 200, "forfeits": false, "shadow_agreement": null, "latency_ms": null, "shadow_observations": 1000}, "nightly": {"minutes": null, "steps": null, "opponents": null, "exploiter": 0.15}, "sweep": null}','{"agents": {"player_1": {"observation": {"type": "dict", "spaces": {"observation": {"type": "box", "dtype": "int8", "shape": [3, 3, 2], "low": 0, "high": 1}, "action_mask": {"type": "box", "dtype": "int8", "shape": [9], "low": 0, "high": 1}}}, "action": {"type": "discrete", "n": 9, "start": 0, "dtype": "int64"}}, "player_2": {"observation": {"type": "dict", "spaces": {"observation": {"type": "box", "dtype": "int8", "shape": [3, 3, 2], "low": 0, "high": 1}, "action_mask": {"type": "box", "dtype": "int8", "shape": [9], "low": 0, "high": 1}}}, "action": {"type": "discrete", "n": 9, "start": 0, "dtype": "int64"}}}, "policies": {"player_1": "shared", "player_2": "shared"}, "sides": {"player_1": ["player_1"], "player_2": ["player_2"]}, "hidden_information": false, "simultaneous": false}','6d16b4a0bbbcd7092066a50ab35ee08620ba08fcf07f405918f7341d48ea7651','59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832','{"environment": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832", "environment.source": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855", "gymnasium": "1.2.2", "numpy": "2.4.6", "pettingzoo": "1.27.0", "play.opening_plies": 0, "play.scoring": null, "play.max_moves": 10000}','ea541f2a26bce9dc7714c7a045b8015b504235e736f7d4cdaf9a26ee382072db',4,'2026-11-26 23:11:11.739530',NULL);
CREATE TABLE matches (
	schedule VARCHAR(255) NOT NULL, 
	position INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	first TEXT NOT NULL, 
	second TEXT NOT NULL, 
	games INTEGER NOT NULL, 
	scores TEXT NOT NULL, 
	returns TEXT NOT NULL, 
	moves TEXT NOT NULL, 
	played_at DATETIME NOT NULL, 
	CONSTRAINT pk_matches PRIMARY KEY (schedule, position), 
	CONSTRAINT fk_matches_schedule FOREIGN KEY(schedule) REFERENCES schedules (id)
);
INSERT INTO "matches" VALUES('tictactoe-round_robin-1',0,'tictactoe','tictactoe@1','tictactoe@2',2,'[1.5,0.5]','[1.25,-0.75]','[4469158401452630045,[0,1],[[[0,1],[3,0,0],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,0],[0.25,0.25],[0.5,0.5]]]]','2026-11-26 23:11:12.519144');
INSERT INTO "matches" VALUES('tictactoe-round_robin-1',1,'tictactoe','tictactoe@1','script:random',2,'[1.5,0.5]','[1.25,-0.75]','[453824526341104212,[1,1],[[[0,1],[3,0,1],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,1],[0.25,0.25],[0.5,0.5]]]]','2026-11-26 23:11:12.519144');
INSERT INTO "matches" VALUES('tictactoe-round_robin-1',2,'tictactoe','tictactoe@2','script:random',2,'[1.5,0.5]','[1.25,-0.75]','[8350938862647943808,[2,1],[[[0,1],[3,0,2],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,2],[0.25,0.25],[0.5,0.5]]]]','2026-11-26 23:11:12.519144');
INSERT INTO "matches" VALUES('tictactoe-verdict-0123456789abcdef0123456789abcdef',0,'tictactoe','tictactoe@2','tictactoe@1',2,'[1.5,0.5]','[1.25,-0.75]','[4469158401452630045,[0,1],[[[0,1],[3,0,0],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,0],[0.25,0.25],[0.5,0.5]]]]','2026-11-26 23:11:12.542656');
INSERT INTO "matches" VALUES('tictactoe-verdict-0123456789abcdef0123456789abcdef',1,'tictactoe','tictactoe@2','tictactoe@1',2,'[1.5,0.5]','[1.25,-0.75]','[453824526341104212,[1,1],[[[0,1],[3,0,1],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,1],[0.25,0.25],[0.5,0.5]]]]','2026-11-26 23:11:12.542656');
INSERT INTO "matches" VALUES('tictactoe-verdict-0123456789abcdef0123456789abcdef',2,'tictactoe','tictactoe@2','tictactoe@1',2,'[1.5,0.5]','[1.25,-0.75]','[8350938862647943808,[2,1],[[[0,1],[3,0,2],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,2],[0.25,0.25],[0.5,0.5]]]]','2026-11-26 23:11:12.542656');
CREATE TABLE nightly_runs (
	id INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	candidates JSON NOT NULL, 
	alpha DOUBLE NOT NULL, 
	report JSON, 
	began_at DATETIME NOT NULL, 
	ended_at DATETIME, 
	CONSTRAINT pk_nightly_runs PRIMARY KEY (id), 
	CONSTRAINT fk_nightly_runs_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "nightly_runs" VALUES(1,'tictactoe','[2]',0.01,'{"champion": "tictactoe@2"}','2026-11-26 23:11:12.556847','2026-11-26 23:11:12.606960');
CREATE TABLE replicas (
	replica VARCHAR(255) NOT NULL, 
	process JSON NOT NULL, 
	changes BIGINT, 
	event INTEGER, 
	traffic INTEGER, 
	seen_at DATETIME NOT NULL, 
	CONSTRAINT pk_replicas PRIMARY KEY (replica)
);
INSERT INTO "replicas" VALUES('replica-1','{"process": "machine/1:2:3"}',5,4,1,'2026-11-26 23:11:12.883049');
INSERT INTO "replicas" VALUES('replica-2','{"process": "machine/1:3:3"}',5,3,1,'2026-11-26 23:11:12.901902');
CREATE TABLE reports (
	replica VARCHAR(255) NOT NULL, 
	document JSON NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_reports PRIMARY KEY (replica)
);
INSERT INTO "reports" VALUES('replica-1','{"requests_total": []}','2026-11-26 23:11:12.909824');
CREATE TABLE run_points (
	league VARCHAR(255) NOT NULL, 
	run VARCHAR(64) NOT NULL, 
	steps BIGINT NOT NULL, 
	curves JSON NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_run_points PRIMARY KEY (league, run, steps), 
	CONSTRAINT fk_run_points_league_run FOREIGN KEY(league, run) REFERENCES runs (league, id)
);
INSERT INTO "run_points" VALUES('tictactoe','run',1000,'{"return": 0.25}','2026-11-26 23:11:12.765933');
INSERT INTO "run_points" VALUES('tictactoe','run',2000,'{"return": 0.5}','2026-11-26 23:11:12.793247');
CREATE TABLE runs (
	league VARCHAR(255) NOT NULL, 
	id VARCHAR(64) NOT NULL, 
	algorithm VARCHAR(32) NOT NULL, 
	settings JSON NOT NULL, 
	seed BIGINT NOT NULL, 
	target BIGINT, 
	parent INTEGER, 
	exploits TEXT, 
	state VARCHAR(16) NOT NULL, 
	error TEXT, 
	attempts INTEGER NOT NULL, 
	driver TEXT NOT NULL, 
	record JSON, 
	steps BIGINT NOT NULL, 
	seconds DOUBLE NOT NULL, 
	curves JSON NOT NULL, 
	spacing BIGINT NOT NULL, 
	began_at DATETIME NOT NULL, 
	heartbeat_at DATETIME NOT NULL, 
	ended_at DATETIME, 
	CONSTRAINT pk_runs PRIMARY KEY (league, id), 
	CONSTRAINT fk_runs_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "runs" VALUES('tictactoe','run','ppo','{"lr": 0.0003}',7,2000,NULL,NULL,'ended',NULL,1,'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933','{"git_commit": null}',2000,60.0,'{"return": 0.5}',0,'2026-11-26 23:11:12.743589','2026-11-26 23:11:12.816612','2026-11-26 23:11:12.816612');
CREATE TABLE schedules (
	sequence INTEGER NOT NULL, 
	id VARCHAR(255) NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	kind VARCHAR(32) NOT NULL, 
	document TEXT NOT NULL, 
	opened_at DATETIME NOT NULL, 
	purged_at DATETIME, 
	CONSTRAINT pk_schedules PRIMARY KEY (sequence), 
	CONSTRAINT fk_schedules_league FOREIGN KEY(league) REFERENCES leagues (slug), 
	CONSTRAINT uq_schedules_id UNIQUE (id)
);
INSERT INTO "schedules" VALUES(1,'tictactoe-round_robin-1','tictactoe','round_robin','{"id":"tictactoe-round_robin-1","league":"tictactoe","kind":"round_robin","seed":9223372036854775807,"environment_digest":"59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832","game_digest":"ea541f2a26bce9dc7714c7a045b8015b504235e736f7d4cdaf9a26ee382072db","sides":["player_1","player_2"],"contestants":["tictactoe@1","tictactoe@2","script:random"],"pairings":[[0,1],[0,2],[1,2]],"length":9,"opening_plies":2,"scoring":"game","actions":"greedy","common_seeds":false}','2026-11-26 23:11:12.332039',NULL);
INSERT INTO "schedules" VALUES(2,'tictactoe-verdict-0123456789abcdef0123456789abcdef','tictactoe','verdict','{"id":"tictactoe-verdict-0123456789abcdef0123456789abcdef","league":"tictactoe","kind":"verdict","seed":9223372036854775807,"environment_digest":"59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832","game_digest":"ea541f2a26bce9dc7714c7a045b8015b504235e736f7d4cdaf9a26ee382072db","sides":["player_1","player_2"],"contestants":["tictactoe@2","tictactoe@1"],"pairings":[[0,1]],"length":9,"opening_plies":2,"scoring":"game","actions":"greedy","common_seeds":false}','2026-11-26 23:11:12.533137',NULL);
CREATE TABLE shadow_counts (
	replica VARCHAR(255) NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	candidate INTEGER NOT NULL, 
	champion INTEGER NOT NULL, 
	requests BIGINT NOT NULL, 
	observations BIGINT NOT NULL, 
	agreed BIGINT NOT NULL, 
	failed BIGINT NOT NULL, 
	dropped BIGINT NOT NULL, 
	skipped BIGINT NOT NULL, 
	latency JSON NOT NULL, 
	ns BIGINT NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_shadow_counts PRIMARY KEY (replica, league, candidate, champion), 
	CONSTRAINT fk_shadow_counts_league_candidate FOREIGN KEY(league, candidate) REFERENCES versions (league, number), 
	CONSTRAINT fk_shadow_counts_league_champion FOREIGN KEY(league, champion) REFERENCES versions (league, number)
);
INSERT INTO "shadow_counts" VALUES('replica-1','tictactoe',2,1,10,20,15,1,0,2,'[1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]',5000,'2026-11-26 23:11:12.910992');
CREATE TABLE snapshots (
	league VARCHAR(255) NOT NULL, 
	part VARCHAR(300) NOT NULL, 
	mark TEXT NOT NULL, 
	document JSON NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_snapshots PRIMARY KEY (league, part), 
	CONSTRAINT fk_snapshots_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "snapshots" VALUES('tictactoe','summary','1; 3db8c2a09dcf; matches: 6; versions: 4; promotions: 3; verdicts, closed, void: 1 1 0','{"matches": 6}','2026-11-26 23:11:12.852341');
CREATE TABLE strengths (
	league VARCHAR(255) NOT NULL, 
	version INTEGER NOT NULL, 
	opponent VARCHAR(512) NOT NULL, 
	run VARCHAR(64) NOT NULL, 
	steps BIGINT NOT NULL, 
	games INTEGER NOT NULL, 
	score DOUBLE NOT NULL, 
	low DOUBLE NOT NULL, 
	high DOUBLE NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_strengths PRIMARY KEY (league, version, opponent), 
	CONSTRAINT fk_strengths_league_version FOREIGN KEY(league, version) REFERENCES versions (league, number)
);
INSERT INTO "strengths" VALUES('tictactoe',2,'tictactoe@1','run',2000,100,0.75,0.6,0.9,'2026-11-26 23:11:12.823557');
CREATE TABLE traffic_events (
	id INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	canary VARCHAR(255), 
	canary_share DOUBLE, 
	shadow VARCHAR(255), 
	shadow_share DOUBLE, 
	actor TEXT NOT NULL, 
	reason TEXT NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_traffic_events PRIMARY KEY (id), 
	CONSTRAINT fk_traffic_events_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "traffic_events" VALUES(1,'tictactoe','2',0.25,'candidate',0.5,'ada','try it','2026-11-26 23:11:12.680000');
CREATE TABLE training_nights (
	id INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	parent INTEGER, 
	steps JSON NOT NULL, 
	began_at DATETIME NOT NULL, 
	ended_at DATETIME, 
	CONSTRAINT pk_training_nights PRIMARY KEY (id), 
	CONSTRAINT fk_training_nights_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "training_nights" VALUES(1,1,'tictactoe',1,'{"train": {"versions": ["tictactoe@2"], "start": 1}}','2026-11-26 23:11:12.633051','2026-11-26 23:11:12.655453');
CREATE TABLE verdicts (
	id VARCHAR(255) NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	candidate INTEGER NOT NULL, 
	champion TEXT NOT NULL, 
	settings JSON NOT NULL, 
	outcome VARCHAR(16), 
	evidence JSON, 
	opened_at DATETIME NOT NULL, 
	closed_at DATETIME, 
	CONSTRAINT pk_verdicts PRIMARY KEY (id), 
	CONSTRAINT fk_verdicts_league_candidate FOREIGN KEY(league, candidate) REFERENCES versions (league, number)
);
INSERT INTO "verdicts" VALUES('tictactoe-verdict-0123456789abcdef0123456789abcdef','tictactoe',2,'tictactoe@1','{"gate": {"alpha": 0.01}, "night": 1, "tests": [{"kind": "anchor", "schedule": "tictactoe-round_robin-1", "ref": "script:random", "margin": 0.1, "mode": "no_worse"}]}','promote','{"promoted": true, "elo": 42.0}','2026-11-26 23:11:12.566270','2026-11-26 23:11:12.597234');
CREATE TABLE version_notes (
	id INTEGER NOT NULL, 
	league VARCHAR(255) NOT NULL, 
	version INTEGER NOT NULL, 
	text TEXT NOT NULL, 
	actor TEXT NOT NULL, 
	at DATETIME NOT NULL, 
	CONSTRAINT pk_version_notes PRIMARY KEY (id), 
	CONSTRAINT fk_version_notes_league_version FOREIGN KEY(league, version) REFERENCES versions (league, number)
);
INSERT INTO "version_notes" VALUES(1,'tictactoe',1,'the first','ada','2026-11-26 23:11:12.275899');
CREATE TABLE versions (
	league VARCHAR(255) NOT NULL, 
	number INTEGER NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	source TEXT NOT NULL, 
	parent INTEGER, 
	role VARCHAR(16) NOT NULL, 
	exploits TEXT, 
	publisher TEXT NOT NULL, 
	reserved_at DATETIME NOT NULL, 
	manifest TEXT, 
	sha256 VARCHAR(64), 
	retired_at DATETIME, 
	CONSTRAINT pk_versions PRIMARY KEY (league, number), 
	CONSTRAINT fk_versions_league_parent FOREIGN KEY(league, parent) REFERENCES versions (league, number), 
	CONSTRAINT fk_versions_league FOREIGN KEY(league) REFERENCES leagues (slug)
);
INSERT INTO "versions" VALUES('tictactoe',1,'ready','run/1000',NULL,'main',NULL,'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933','2026-11-26 23:11:11.865805','{
  "league": "tictactoe",
  "version": 1,
  "created_at": "2026-11-26T23:11:11.894018Z",
  "interface": {
    "agents": {
      "player_1": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      },
      "player_2": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      }
    },
    "policies": {
      "player_1": "shared",
      "player_2": "shared"
    },
    "sides": {
      "player_1": [
        "player_1"
      ],
      "player_2": [
        "player_2"
      ]
    },
    "hidden_information": false,
    "simultaneous": false
  },
  "policies": {
    "shared": {
      "file": "shared.onnx",
      "observation": {
        "type": "dict",
        "spaces": {
          "observation": {
            "type": "box",
            "dtype": "int8",
            "shape": [
              3,
              3,
              2
            ],
            "low": 0,
            "high": 1
          },
          "action_mask": {
            "type": "box",
            "dtype": "int8",
            "shape": [
              9
            ],
            "low": 0,
            "high": 1
          }
        }
      },
      "action": {
        "type": "discrete",
        "n": 9,
        "start": 0,
        "dtype": "int64"
      },
      "inputs": [
        {
          "name": "observation",
          "dtype": "int8",
          "shape": [
            null,
            3,
            3,
            2
          ]
        },
        {
          "name": "action_mask",
          "dtype": "int8",
          "shape": [
            null,
            9
          ]
        }
      ],
      "outputs": [
        {
          "name": "action",
          "dtype": "int64",
          "shape": [
            null
          ]
        },
        {
          "name": "action_dist_inputs",
          "dtype": "float32",
          "shape": [
            null,
            9
          ]
        }
      ],
      "state": [],
      "parity": {
        "observations": 2000,
        "mismatches": 0,
        "near_ties": 1,
        "max_difference": 3e-7
      },
      "probes": null
    }
  },
  "environment": {
    "entry_point": "pettingzoo.classic.tictactoe_v3",
    "api": null,
    "kwargs": {},
    "wrappers": [],
    "vector": null,
    "revision": null
  },
  "environment_digest": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832",
  "algorithm": "ppo",
  "settings": {
    "lr": 0.0003
  },
  "seed": 1,
  "steps": 1000,
  "parent": null,
  "role": "main",
  "exploits": null,
  "mixture": null,
  "git_commit": null,
  "stack": {
    "onnxruntime": "1.0"
  },
  "files": {
    "shared.onnx": "cb5632dfa402312a608271ed081dd5aa6641203bd01d4864ea5a4d6e4033a501",
    "training/learner/weights.bin": "9a129038d9a00aed0cf6a7ea059ca50a813449061ab87848cf1a13eafdf33b2c",
    "training/state.bin": "40aff2e9d2d8922e47afd4648e6967497158785fbd1da870e7110266bf944880"
  }
}
','3ebc62ccda222f4dbeac113a97cd0b8aee4c3d04000f055234d6381b75006990',NULL);
INSERT INTO "versions" VALUES('tictactoe',2,'ready','run/2000',1,'main',NULL,'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933','2026-11-26 23:11:11.980830','{
  "league": "tictactoe",
  "version": 2,
  "created_at": "2026-11-26T23:11:12.006840Z",
  "interface": {
    "agents": {
      "player_1": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      },
      "player_2": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      }
    },
    "policies": {
      "player_1": "shared",
      "player_2": "shared"
    },
    "sides": {
      "player_1": [
        "player_1"
      ],
      "player_2": [
        "player_2"
      ]
    },
    "hidden_information": false,
    "simultaneous": false
  },
  "policies": {
    "shared": {
      "file": "shared.onnx",
      "observation": {
        "type": "dict",
        "spaces": {
          "observation": {
            "type": "box",
            "dtype": "int8",
            "shape": [
              3,
              3,
              2
            ],
            "low": 0,
            "high": 1
          },
          "action_mask": {
            "type": "box",
            "dtype": "int8",
            "shape": [
              9
            ],
            "low": 0,
            "high": 1
          }
        }
      },
      "action": {
        "type": "discrete",
        "n": 9,
        "start": 0,
        "dtype": "int64"
      },
      "inputs": [
        {
          "name": "observation",
          "dtype": "int8",
          "shape": [
            null,
            3,
            3,
            2
          ]
        },
        {
          "name": "action_mask",
          "dtype": "int8",
          "shape": [
            null,
            9
          ]
        }
      ],
      "outputs": [
        {
          "name": "action",
          "dtype": "int64",
          "shape": [
            null
          ]
        },
        {
          "name": "action_dist_inputs",
          "dtype": "float32",
          "shape": [
            null,
            9
          ]
        }
      ],
      "state": [],
      "parity": {
        "observations": 2000,
        "mismatches": 0,
        "near_ties": 1,
        "max_difference": 3e-7
      },
      "probes": null
    }
  },
  "environment": {
    "entry_point": "pettingzoo.classic.tictactoe_v3",
    "api": null,
    "kwargs": {},
    "wrappers": [],
    "vector": null,
    "revision": null
  },
  "environment_digest": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832",
  "algorithm": "ppo",
  "settings": {
    "lr": 0.0003
  },
  "seed": 1,
  "steps": 2000,
  "parent": 1,
  "role": "main",
  "exploits": null,
  "mixture": null,
  "git_commit": null,
  "stack": {
    "onnxruntime": "1.0"
  },
  "files": {
    "shared.onnx": "cb5632dfa402312a608271ed081dd5aa6641203bd01d4864ea5a4d6e4033a501",
    "training/learner/weights.bin": "9a129038d9a00aed0cf6a7ea059ca50a813449061ab87848cf1a13eafdf33b2c",
    "training/state.bin": "40aff2e9d2d8922e47afd4648e6967497158785fbd1da870e7110266bf944880"
  }
}
','a5a453c90b4c473888ffdfdd2eaf4c04e18c87d594558c4b97681861b974b167',NULL);
INSERT INTO "versions" VALUES('tictactoe',3,'ready','exploiter/500',NULL,'exploiter','tictactoe@1','vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933','2026-11-26 23:11:12.066709','{
  "league": "tictactoe",
  "version": 3,
  "created_at": "2026-11-26T23:11:12.070924Z",
  "interface": {
    "agents": {
      "player_1": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      },
      "player_2": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      }
    },
    "policies": {
      "player_1": "shared",
      "player_2": "shared"
    },
    "sides": {
      "player_1": [
        "player_1"
      ],
      "player_2": [
        "player_2"
      ]
    },
    "hidden_information": false,
    "simultaneous": false
  },
  "policies": {
    "shared": {
      "file": "shared.onnx",
      "observation": {
        "type": "dict",
        "spaces": {
          "observation": {
            "type": "box",
            "dtype": "int8",
            "shape": [
              3,
              3,
              2
            ],
            "low": 0,
            "high": 1
          },
          "action_mask": {
            "type": "box",
            "dtype": "int8",
            "shape": [
              9
            ],
            "low": 0,
            "high": 1
          }
        }
      },
      "action": {
        "type": "discrete",
        "n": 9,
        "start": 0,
        "dtype": "int64"
      },
      "inputs": [
        {
          "name": "observation",
          "dtype": "int8",
          "shape": [
            null,
            3,
            3,
            2
          ]
        },
        {
          "name": "action_mask",
          "dtype": "int8",
          "shape": [
            null,
            9
          ]
        }
      ],
      "outputs": [
        {
          "name": "action",
          "dtype": "int64",
          "shape": [
            null
          ]
        },
        {
          "name": "action_dist_inputs",
          "dtype": "float32",
          "shape": [
            null,
            9
          ]
        }
      ],
      "state": [],
      "parity": {
        "observations": 2000,
        "mismatches": 0,
        "near_ties": 1,
        "max_difference": 3e-7
      },
      "probes": null
    }
  },
  "environment": {
    "entry_point": "pettingzoo.classic.tictactoe_v3",
    "api": null,
    "kwargs": {},
    "wrappers": [],
    "vector": null,
    "revision": null
  },
  "environment_digest": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832",
  "algorithm": "ppo",
  "settings": {
    "lr": 0.0003
  },
  "seed": 1,
  "steps": 3000,
  "parent": null,
  "role": "exploiter",
  "exploits": "tictactoe@1",
  "mixture": null,
  "git_commit": null,
  "stack": {
    "onnxruntime": "1.0"
  },
  "files": {
    "shared.onnx": "cb5632dfa402312a608271ed081dd5aa6641203bd01d4864ea5a4d6e4033a501",
    "training/learner/weights.bin": "9a129038d9a00aed0cf6a7ea059ca50a813449061ab87848cf1a13eafdf33b2c",
    "training/state.bin": "40aff2e9d2d8922e47afd4648e6967497158785fbd1da870e7110266bf944880"
  }
}
','42e5026b92a698c8bbc25341e93e57047cbe57b7ddefc85252c336c06e76d282',NULL);
INSERT INTO "versions" VALUES('tictactoe',4,'ready','mixture/1:0.25,2:0.75',NULL,'mixture',NULL,'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933','2026-11-26 23:11:12.197207','{
  "league": "tictactoe",
  "version": 4,
  "created_at": "2026-11-26T23:11:12.201885Z",
  "interface": {
    "agents": {
      "player_1": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      },
      "player_2": {
        "observation": {
          "type": "dict",
          "spaces": {
            "observation": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                3,
                3,
                2
              ],
              "low": 0,
              "high": 1
            },
            "action_mask": {
              "type": "box",
              "dtype": "int8",
              "shape": [
                9
              ],
              "low": 0,
              "high": 1
            }
          }
        },
        "action": {
          "type": "discrete",
          "n": 9,
          "start": 0,
          "dtype": "int64"
        }
      }
    },
    "policies": {
      "player_1": "shared",
      "player_2": "shared"
    },
    "sides": {
      "player_1": [
        "player_1"
      ],
      "player_2": [
        "player_2"
      ]
    },
    "hidden_information": false,
    "simultaneous": false
  },
  "policies": {},
  "environment": {
    "entry_point": "pettingzoo.classic.tictactoe_v3",
    "api": null,
    "kwargs": {},
    "wrappers": [],
    "vector": null,
    "revision": null
  },
  "environment_digest": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832",
  "algorithm": "mixture",
  "settings": {},
  "seed": 0,
  "steps": 2000,
  "parent": null,
  "role": "mixture",
  "exploits": null,
  "mixture": {
    "members": [
      {
        "version": 1,
        "probability": 0.25,
        "sha256": "3ebc62ccda222f4dbeac113a97cd0b8aee4c3d04000f055234d6381b75006990"
      },
      {
        "version": 2,
        "probability": 0.75,
        "sha256": "a5a453c90b4c473888ffdfdd2eaf4c04e18c87d594558c4b97681861b974b167"
      }
    ]
  },
  "git_commit": null,
  "stack": {},
  "files": {}
}
','4e4f4291e07691d519b7e3c4413d4480fe101a2be6f02b60e4facbeff866e564',NULL);
CREATE INDEX ix_replicas_seen_at ON replicas (seen_at);
CREATE INDEX ix_reports_at ON reports (at);
CREATE INDEX ix_acknowledgements_seen_at ON acknowledgements (seen_at);
CREATE INDEX ix_evaluations_league_id ON evaluations (league, id);
CREATE INDEX ix_evaluations_state ON evaluations (state);
CREATE INDEX ix_nightly_runs_league_id ON nightly_runs (league, id);
CREATE INDEX ix_schedules_league ON schedules (league);
CREATE INDEX ix_traffic_events_league_id ON traffic_events (league, id);
CREATE INDEX ix_training_nights_league_id ON training_nights (league, id);
CREATE UNIQUE INDEX uq_versions_ready_source ON versions (league, source) WHERE state = 'ready';
CREATE INDEX ix_matches_league_first_second_played_at ON matches (league, first, second, played_at);
CREATE INDEX ix_matches_league_played_at ON matches (league, played_at);
CREATE INDEX ix_shadow_counts_at ON shadow_counts (at);
CREATE INDEX ix_strengths_league_run ON strengths (league, run);
CREATE INDEX ix_verdicts_league ON verdicts (league);
CREATE INDEX ix_version_notes_league_id ON version_notes (league, id);
CREATE INDEX ix_version_notes_league_version_id ON version_notes (league, version, id);
CREATE INDEX ix_alias_events_league_alias_id ON alias_events (league, alias, id);
CREATE INDEX ix_idempotent_calls_at ON idempotent_calls (at);
COMMIT;
