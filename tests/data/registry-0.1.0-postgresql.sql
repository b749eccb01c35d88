CREATE TABLE acknowledgements (
    replica character varying(255) NOT NULL,
    league character varying(255) NOT NULL,
    version integer,
    sha256 character varying(64),
    fault text,
    aliases json NOT NULL,
    traffic integer,
    event integer,
    seen_at timestamp with time zone NOT NULL
);
CREATE TABLE alembic_version (
    version_num character varying(32) NOT NULL
);
CREATE TABLE alias_events (
    id integer NOT NULL,
    league character varying(255) NOT NULL,
    alias character varying(255) NOT NULL,
    kind character varying(16) NOT NULL,
    version integer NOT NULL,
    previous integer,
    beneath integer,
    actor text NOT NULL,
    reason text NOT NULL,
    verdict character varying(255),
    at timestamp with time zone NOT NULL
);
CREATE SEQUENCE alias_events_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE alias_events_id_seq OWNED BY alias_events.id;
CREATE TABLE aliases (
    league character varying(255) NOT NULL,
    name character varying(255) NOT NULL,
    version integer NOT NULL,
    event integer NOT NULL
);
CREATE TABLE api_keys (
    id character varying(8) NOT NULL,
    name character varying(255) NOT NULL,
    sha256 character varying(64) NOT NULL,
    scopes json NOT NULL,
    leagues json,
    rate double precision,
    created_at timestamp with time zone NOT NULL,
    expires_at timestamp with time zone,
    revoked_at timestamp with time zone
);
CREATE TABLE change_counter (
    id integer NOT NULL,
    aliases bigint DEFAULT '0'::bigint NOT NULL,
    traffic bigint DEFAULT '0'::bigint NOT NULL,
    keys bigint DEFAULT '0'::bigint NOT NULL,
    leagues bigint DEFAULT '0'::bigint NOT NULL
);
CREATE TABLE earlier_games (
    league character varying(255) NOT NULL,
    digest character varying(64) NOT NULL,
    game json NOT NULL,
    replaced_at timestamp with time zone NOT NULL
);
CREATE TABLE evaluations (
    id integer NOT NULL,
    league character varying(255) NOT NULL,
    request json NOT NULL,
    state character varying(16) NOT NULL,
    progress json,
    result json,
    error json,
    actor text NOT NULL,
    key character varying(8),
    reason text,
    workers integer,
    runner character varying(64),
    attempts integer NOT NULL,
    created_at timestamp with time zone NOT NULL,
    started_at timestamp with time zone,
    heartbeat_at timestamp with time zone,
    stop_at timestamp with time zone,
    stopped_by text,
    ended_at timestamp with time zone
);
CREATE SEQUENCE evaluations_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE evaluations_id_seq OWNED BY evaluations.id;
CREATE TABLE idempotent_calls (
    owner character varying(8) NOT NULL,
    key character varying(255) NOT NULL,
    digest character varying(64) NOT NULL,
    event integer,
    traffic integer,
    evaluation integer,
    at timestamp with time zone NOT NULL
);
CREATE TABLE leagues (
    slug character varying(255) NOT NULL,
    config json NOT NULL,
    interface json NOT NULL,
    interface_digest character varying(64) NOT NULL,
    environment_digest character varying(64) NOT NULL,
    game json NOT NULL,
    game_digest character varying(64) NOT NULL,
    last_version integer NOT NULL,
    registered_at timestamp with time zone NOT NULL,
    archived_at timestamp with time zone
);
CREATE TABLE matches (
    schedule character varying(255) NOT NULL,
    "position" integer NOT NULL,
    league character varying(255) NOT NULL,
    first text NOT NULL,
    second text NOT NULL,
    games integer NOT NULL,
    scores text NOT NULL,
    returns text NOT NULL,
    moves text NOT NULL,
    played_at timestamp with time zone NOT NULL
);
CREATE TABLE nightly_runs (
    id integer NOT NULL,
    league character varying(255) NOT NULL,
    candidates json NOT NULL,
    alpha double precision NOT NULL,
    report json,
    began_at timestamp with time zone NOT NULL,
    ended_at timestamp with time zone
);
CREATE SEQUENCE nightly_runs_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE nightly_runs_id_seq OWNED BY nightly_runs.id;
CREATE TABLE replicas (
    replica character varying(255) NOT NULL,
    process json NOT NULL,
    changes bigint,
    event integer,
    traffic integer,
    seen_at timestamp with time zone NOT NULL
);
CREATE TABLE reports (
    replica character varying(255) NOT NULL,
    document json NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE TABLE run_points (
    league character varying(255) NOT NULL,
    run character varying(64) NOT NULL,
    steps bigint NOT NULL,
    curves json NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE TABLE runs (
    league character varying(255) NOT NULL,
    id character varying(64) NOT NULL,
    algorithm character varying(32) NOT NULL,
    settings json NOT NULL,
    seed bigint NOT NULL,
    target bigint,
    parent integer,
    exploits text,
    state character varying(16) NOT NULL,
    error text,
    attempts integer NOT NULL,
    driver text NOT NULL,
    record json,
    steps bigint NOT NULL,
    seconds double precision NOT NULL,
    curves json NOT NULL,
    spacing bigint NOT NULL,
    began_at timestamp with time zone NOT NULL,
    heartbeat_at timestamp with time zone NOT NULL,
    ended_at timestamp with time zone
);
CREATE TABLE schedules (
    sequence integer NOT NULL,
    id character varying(255) NOT NULL,
    league character varying(255) NOT NULL,
    kind character varying(32) NOT NULL,
    document text NOT NULL,
    opened_at timestamp with time zone NOT NULL,
    purged_at timestamp with time zone
);
CREATE SEQUENCE schedules_sequence_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE schedules_sequence_seq OWNED BY schedules.sequence;
CREATE TABLE shadow_counts (
    replica character varying(255) NOT NULL,
    league character varying(255) NOT NULL,
    candidate integer NOT NULL,
    champion integer NOT NULL,
    requests bigint NOT NULL,
    observations bigint NOT NULL,
    agreed bigint NOT NULL,
    failed bigint NOT NULL,
    dropped bigint NOT NULL,
    skipped bigint NOT NULL,
    latency json NOT NULL,
    ns bigint NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE TABLE snapshots (
    league character varying(255) NOT NULL,
    part character varying(300) NOT NULL,
    mark text NOT NULL,
    document json NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE TABLE strengths (
    league character varying(255) NOT NULL,
    version integer NOT NULL,
    opponent character varying(512) NOT NULL,
    run character varying(64) NOT NULL,
    steps bigint NOT NULL,
    games integer NOT NULL,
    score double precision NOT NULL,
    low double precision NOT NULL,
    high double precision NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE TABLE traffic_events (
    id integer NOT NULL,
    league character varying(255) NOT NULL,
    canary character varying(255),
    canary_share double precision,
    shadow character varying(255),
    shadow_share double precision,
    actor text NOT NULL,
    reason text NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE SEQUENCE traffic_events_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE traffic_events_id_seq OWNED BY traffic_events.id;
CREATE TABLE training_nights (
    id integer NOT NULL,
    number integer NOT NULL,
    league character varying(255) NOT NULL,
    parent integer,
    steps json NOT NULL,
    began_at timestamp with time zone NOT NULL,
    ended_at timestamp with time zone
);
CREATE SEQUENCE training_nights_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE training_nights_id_seq OWNED BY training_nights.id;
CREATE TABLE verdicts (
    id character varying(255) NOT NULL,
    league character varying(255) NOT NULL,
    candidate integer NOT NULL,
    champion text NOT NULL,
    settings json NOT NULL,
    outcome character varying(16),
    evidence json,
    opened_at timestamp with time zone NOT NULL,
    closed_at timestamp with time zone
);
CREATE TABLE version_notes (
    id integer NOT NULL,
    league character varying(255) NOT NULL,
    version integer NOT NULL,
    text text NOT NULL,
    actor text NOT NULL,
    at timestamp with time zone NOT NULL
);
CREATE SEQUENCE version_notes_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE version_notes_id_seq OWNED BY version_notes.id;
CREATE TABLE versions (
    league character varying(255) NOT NULL,
    number integer NOT NULL,
    state character varying(16) NOT NULL,
    source text NOT NULL,
    parent integer,
    role character varying(16) NOT NULL,
    exploits text,
    publisher text NOT NULL,
    reserved_at timestamp with time zone NOT NULL,
    manifest text,
    sha256 character varying(64),
    retired_at timestamp with time zone
);
ALTER TABLE ONLY alias_events ALTER COLUMN id SET DEFAULT nextval('alias_events_id_seq'::regclass);
ALTER TABLE ONLY evaluations ALTER COLUMN id SET DEFAULT nextval('evaluations_id_seq'::regclass);
ALTER TABLE ONLY nightly_runs ALTER COLUMN id SET DEFAULT nextval('nightly_runs_id_seq'::regclass);
ALTER TABLE ONLY schedules ALTER COLUMN sequence SET DEFAULT nextval('schedules_sequence_seq'::regclass);
ALTER TABLE ONLY traffic_events ALTER COLUMN id SET DEFAULT nextval('traffic_events_id_seq'::regclass);
ALTER TABLE ONLY training_nights ALTER COLUMN id SET DEFAULT nextval('training_nights_id_seq'::regclass);
ALTER TABLE ONLY version_notes ALTER COLUMN id SET DEFAULT nextval('version_notes_id_seq'::regclass);
INSERT INTO acknowledgements VALUES ('replica-2', 'tictactoe', 1, '0000000000000000000000000000000000000000000000000000000000000000', 'it is loading', '{"champion": 1}', 1, 3, '2026-11-26 23:11:12.902782+00');
INSERT INTO alembic_version VALUES ('0001');
INSERT INTO alias_events VALUES (1, 'tictactoe', 'champion', 'set', 1, NULL, NULL, 'ada', 'the first', NULL, '2026-11-26 23:11:12.312714+00');
INSERT INTO alias_events VALUES (2, 'tictactoe', 'champion', 'set', 2, 1, 1, 'league nightly', 'better', 'tictactoe-verdict-0123456789abcdef0123456789abcdef', '2026-11-26 23:11:12.587671+00');
INSERT INTO alias_events VALUES (3, 'tictactoe', 'champion', 'rollback', 1, 2, NULL, 'ada', 'too slow', NULL, '2026-11-26 23:11:12.61523+00');
INSERT INTO alias_events VALUES (4, 'tictactoe', 'candidate', 'set', 2, NULL, NULL, 'ada', 'again', NULL, '2026-11-26 23:11:12.624158+00');
INSERT INTO aliases VALUES ('tictactoe', 'champion', 1, 3);
INSERT INTO aliases VALUES ('tictactoe', 'candidate', 2, 4);
INSERT INTO api_keys VALUES ('4f9b6777', 'ci', 'd8fe290630e3e5ec2c39de4f4fd361d1ce33ea4dbfd55635e9e5bc76bdcaabf7', '["promote", "read"]', '["tictactoe"]', 20, '2026-11-26 23:11:12.253661+00', NULL, NULL);
INSERT INTO change_counter VALUES (1, 4, 1, 1, 1);
INSERT INTO earlier_games VALUES ('tictactoe', '218f0e9a7309a1f13f6728e985622a170587fb68bd68cdb14cc04e3e106df647', '{"environment": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832", "environment.source": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855", "gymnasium": "1.2.2", "numpy": "2.4.6", "pettingzoo": "1.27.0", "play.opening_plies": 4, "play.scoring": null, "play.max_moves": 10000}', '2026-11-26 23:11:11.822025+00');
INSERT INTO evaluations VALUES (1, 'tictactoe', '{"kind": "tournament", "blocks": 2}', 'done', '{"what": "games", "played": 1, "of": 4}', '{"matches": 4}', NULL, 'ci', '4f9b6777', 'why not', 2, 'runner', 0, '2026-11-26 23:11:12.698469+00', '2026-11-26 23:11:12.706918+00', '2026-11-26 23:11:12.720404+00', NULL, NULL, '2026-11-26 23:11:12.738976+00');
INSERT INTO idempotent_calls VALUES ('4f9b6777', 'a', 'aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa', 1, NULL, NULL, '2026-11-26 23:11:12.288135+00');
INSERT INTO idempotent_calls VALUES ('4f9b6777', 'b', 'bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb', NULL, 1, NULL, '2026-11-26 23:11:12.659104+00');
INSERT INTO idempotent_calls VALUES ('4f9b6777', 'c', 'cccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccccc', NULL, NULL, 1, '2026-11-26 23:11:12.687683+00');
INSERT INTO leagues VALUES ('tictactoe', '{"league": "tictactoe", "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3", "api": null, "kwargs": {}, "wrappers": [], "vector": null, "revision": null}, "folder": null, "policies": null, "sides": null, "play": {"opening_plies": 0, "actions": null, "scoring": null, "num_envs": "auto", "max_moves": 10000, "game_seconds": 600.0, "action_names": null}, "training": {"seed": 0, "steps": null, "minutes": null, "checkpoint_every": "auto", "checkpoint_minutes": null, "runners": 1, "num_envs": "auto", "gamma": 0.99, "grad_clip": 0.5, "convolutions": [], "channels": null, "hidden": [256, 256], "normalize_observations": false, "policies_to_train": null, "opponents": {"fixed": [], "league": null}, "exploiter": {}, "strength": {"games": 200}, "gpus": 0.0, "runner_gpus": 0.0, "crashes": 3, "opening_plies": null, "algorithm": "ppo", "lr": 0.0005, "train_batch_size": 4096, "minibatch_size": 512, "epochs": 4, "lambda": 0.95, "clip": 0.2, "entropy": 0.05, "value_loss": 0.5, "magnet": null, "teacher": null, "recurrence": null, "shared_encoder": false, "per_policy": {}}, "gate": {"model": "normalized", "elo0": 0.0, "elo1": 30.0, "return0": 0.0, "return1": 0.0, "return_bound": null, "alpha": 0.05, "nights": 365, "beta": 0.05, "max_blocks": 4000, "anchors": [], "earlier_champions": 2, "margin": 50.0, "exploited_champions": 2, "exploiter_margin": null, "exploiters": {"count": 0, "budget": 0.15, "blocks": 200, "improvement": 0.0}, "confirmation_blocks": 200, "forfeits": false, "shadow_agreement": null, "latency_ms": null, "shadow_observations": 1000}, "nightly": {"minutes": null, "steps": null, "opponents": null, "exploiter": 0.15}, "sweep": null}', '{"agents": {"player_1": {"observation": {"type": "dict", "spaces": {"observation": {"type": "box", "dtype": "int8", "shape": [3, 3, 2], "low": 0, "high": 1}, "action_mask": {"type": "box", "dtype": "int8", "shape": [9], "low": 0, "high": 1}}}, "action": {"type": "discrete", "n": 9, "start": 0, "dtype": "int64"}}, "player_2": {"observation": {"type": "dict", "spaces": {"observation": {"type": "box", "dtype": "int8", "shape": [3, 3, 2], "low": 0, "high": 1}, "action_mask": {"type": "box", "dtype": "int8", "shape": [9], "low": 0, "high": 1}}}, "action": {"type": "discrete", "n": 9, "start": 0, "dtype": "int64"}}}, "policies": {"player_1": "shared", "player_2": "shared"}, "sides": {"player_1": ["player_1"], "player_2": ["player_2"]}, "hidden_information": false, "simultaneous": false}', '6d16b4a0bbbcd7092066a50ab35ee08620ba08fcf07f405918f7341d48ea7651', '59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832', '{"environment": "59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832", "environment.source": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855", "gymnasium": "1.2.2", "numpy": "2.4.6", "pettingzoo": "1.27.0", "play.opening_plies": 0, "play.scoring": null, "play.max_moves": 10000}', 'ea541f2a26bce9dc7714c7a045b8015b504235e736f7d4cdaf9a26ee382072db', 4, '2026-11-26 23:11:11.73953+00', NULL);
INSERT INTO matches VALUES ('tictactoe-round_robin-1', 0, 'tictactoe', 'tictactoe@1', 'tictactoe@2', 2, '[1.5,0.5]', '[1.25,-0.75]', '[4469158401452630045,[0,1],[[[0,1],[3,0,0],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,0],[0.25,0.25],[0.5,0.5]]]]', '2026-11-26 23:11:12.519144+00');
INSERT INTO matches VALUES ('tictactoe-round_robin-1', 1, 'tictactoe', 'tictactoe@1', 'script:random', 2, '[1.5,0.5]', '[1.25,-0.75]', '[453824526341104212,[1,1],[[[0,1],[3,0,1],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,1],[0.25,0.25],[0.5,0.5]]]]', '2026-11-26 23:11:12.519144+00');
INSERT INTO matches VALUES ('tictactoe-round_robin-1', 2, 'tictactoe', 'tictactoe@2', 'script:random', 2, '[1.5,0.5]', '[1.25,-0.75]', '[8350938862647943808,[2,1],[[[0,1],[3,0,2],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,2],[0.25,0.25],[0.5,0.5]]]]', '2026-11-26 23:11:12.519144+00');
INSERT INTO matches VALUES ('tictactoe-verdict-0123456789abcdef0123456789abcdef', 0, 'tictactoe', 'tictactoe@2', 'tictactoe@1', 2, '[1.5,0.5]', '[1.25,-0.75]', '[4469158401452630045,[0,1],[[[0,1],[3,0,0],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,0],[0.25,0.25],[0.5,0.5]]]]', '2026-11-26 23:11:12.542656+00');
INSERT INTO matches VALUES ('tictactoe-verdict-0123456789abcdef0123456789abcdef', 1, 'tictactoe', 'tictactoe@2', 'tictactoe@1', 2, '[1.5,0.5]', '[1.25,-0.75]', '[453824526341104212,[1,1],[[[0,1],[3,0,1],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,1],[0.25,0.25],[0.5,0.5]]]]', '2026-11-26 23:11:12.542656+00');
INSERT INTO matches VALUES ('tictactoe-verdict-0123456789abcdef0123456789abcdef', 2, 'tictactoe', 'tictactoe@2', 'tictactoe@1', 2, '[1.5,0.5]', '[1.25,-0.75]', '[8350938862647943808,[2,1],[[[0,1],[3,0,2],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,1,2],[0.25,0.25],[0.5,0.5]]]]', '2026-11-26 23:11:12.542656+00');
INSERT INTO nightly_runs VALUES (1, 'tictactoe', '[2]', 0.01, '{"champion": "tictactoe@2"}', '2026-11-26 23:11:12.556847+00', '2026-11-26 23:11:12.60696+00');
INSERT INTO replicas VALUES ('replica-1', '{"process": "machine/1:2:3"}', 5, 4, 1, '2026-11-26 23:11:12.883049+00');
INSERT INTO replicas VALUES ('replica-2', '{"process": "machine/1:3:3"}', 5, 3, 1, '2026-11-26 23:11:12.901902+00');
INSERT INTO reports VALUES ('replica-1', '{"requests_total": []}', '2026-11-26 23:11:12.909824+00');
INSERT INTO run_points VALUES ('tictactoe', 'run', 1000, '{"return": 0.25}', '2026-11-26 23:11:12.765933+00');
INSERT INTO run_points VALUES ('tictactoe', 'run', 2000, '{"return": 0.5}', '2026-11-26 23:11:12.793247+00');
INSERT INTO runs VALUES ('tictactoe', 'run', 'ppo', '{"lr": 0.0003}', 7, 2000, NULL, NULL, 'ended', NULL, 1, 'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933', '{"git_commit": null}', 2000, 60, '{"return": 0.5}', 0, '2026-11-26 23:11:12.743589+00', '2026-11-26 23:11:12.816612+00', '2026-11-26 23:11:12.816612+00');
INSERT INTO schedules VALUES (1, 'tictactoe-round_robin-1', 'tictactoe', 'round_robin', '{"id":"tictactoe-round_robin-1","league":"tictactoe","kind":"round_robin","seed":9223372036854775807,"environment_digest":"59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832","game_digest":"ea541f2a26bce9dc7714c7a045b8015b504235e736f7d4cdaf9a26ee382072db","sides":["player_1","player_2"],"contestants":["tictactoe@1","tictactoe@2","script:random"],"pairings":[[0,1],[0,2],[1,2]],"length":9,"opening_plies":2,"scoring":"game","actions":"greedy","common_seeds":false}', '2026-11-26 23:11:12.332039+00', NULL);
INSERT INTO schedules VALUES (2, 'tictactoe-verdict-0123456789abcdef0123456789abcdef', 'tictactoe', 'verdict', '{"id":"tictactoe-verdict-0123456789abcdef0123456789abcdef","league":"tictactoe","kind":"verdict","seed":9223372036854775807,"environment_digest":"59666bb9a018a69650bd0941cb5f08c962ff424b553a5e7419ff1603c78a6832","game_digest":"ea541f2a26bce9dc7714c7a045b8015b504235e736f7d4cdaf9a26ee382072db","sides":["player_1","player_2"],"contestants":["tictactoe@2","tictactoe@1"],"pairings":[[0,1]],"length":9,"opening_plies":2,"scoring":"game","actions":"greedy","common_seeds":false}', '2026-11-26 23:11:12.533137+00', NULL);
INSERT INTO shadow_counts VALUES ('replica-1', 'tictactoe', 2, 1, 10, 20, 15, 1, 0, 2, '[1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]', 5000, '2026-11-26 23:11:12.910992+00');
INSERT INTO snapshots VALUES ('tictactoe', 'summary', '1; 3db8c2a09dcf; matches: 6; versions: 4; promotions: 3; verdicts, closed, void: 1 1 0', '{"matches": 6}', '2026-11-26 23:11:12.852341+00');
INSERT INTO strengths VALUES ('tictactoe', 2, 'tictactoe@1', 'run', 2000, 100, 0.75, 0.6, 0.9, '2026-11-26 23:11:12.823557+00');
INSERT INTO traffic_events VALUES (1, 'tictactoe', '2', 0.25, 'candidate', 0.5, 'ada', 'try it', '2026-11-26 23:11:12.68+00');
INSERT INTO training_nights VALUES (1, 1, 'tictactoe', 1, '{"train": {"versions": ["tictactoe@2"], "start": 1}}', '2026-11-26 23:11:12.633051+00', '2026-11-26 23:11:12.655453+00');
INSERT INTO verdicts VALUES ('tictactoe-verdict-0123456789abcdef0123456789abcdef', 'tictactoe', 2, 'tictactoe@1', '{"gate": {"alpha": 0.01}, "night": 1, "tests": [{"kind": "anchor", "schedule": "tictactoe-round_robin-1", "ref": "script:random", "margin": 0.1, "mode": "no_worse"}]}', 'promote', '{"promoted": true, "elo": 42.0}', '2026-11-26 23:11:12.56627+00', '2026-11-26 23:11:12.597234+00');
INSERT INTO version_notes VALUES (1, 'tictactoe', 1, 'the first', 'ada', '2026-11-26 23:11:12.275899+00');
INSERT INTO versions VALUES ('tictactoe', 1, 'ready', 'run/1000', NULL, 'main', NULL, 'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933', '2026-11-26 23:11:11.865805+00', '{
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
', '3ebc62ccda222f4dbeac113a97cd0b8aee4c3d04000f055234d6381b75006990', NULL);
INSERT INTO versions VALUES ('tictactoe', 2, 'ready', 'run/2000', 1, 'main', NULL, 'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933', '2026-11-26 23:11:11.98083+00', '{
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
', 'a5a453c90b4c473888ffdfdd2eaf4c04e18c87d594558c4b97681861b974b167', NULL);
INSERT INTO versions VALUES ('tictactoe', 3, 'ready', 'exploiter/500', NULL, 'exploiter', 'tictactoe@1', 'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933', '2026-11-26 23:11:12.066709+00', '{
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
', '42e5026b92a698c8bbc25341e93e57047cbe57b7ddefc85252c336c06e76d282', NULL);
INSERT INTO versions VALUES ('tictactoe', 4, 'ready', 'mixture/1:0.25,2:0.75', NULL, 'mixture', NULL, 'vm/b158714a-a379-48f9-8788-d6e901883539/4026531836:25746:409933', '2026-11-26 23:11:12.197207+00', '{
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
', '4e4f4291e07691d519b7e3c4413d4480fe101a2be6f02b60e4facbeff866e564', NULL);
SELECT pg_catalog.setval('alias_events_id_seq', 5, false);
SELECT pg_catalog.setval('evaluations_id_seq', 2, false);
SELECT pg_catalog.setval('nightly_runs_id_seq', 2, false);
SELECT pg_catalog.setval('schedules_sequence_seq', 3, false);
SELECT pg_catalog.setval('traffic_events_id_seq', 2, false);
SELECT pg_catalog.setval('training_nights_id_seq', 2, false);
SELECT pg_catalog.setval('version_notes_id_seq', 2, false);
ALTER TABLE ONLY alembic_version
    ADD CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num);
ALTER TABLE ONLY acknowledgements
    ADD CONSTRAINT pk_acknowledgements PRIMARY KEY (replica, league);
ALTER TABLE ONLY alias_events
    ADD CONSTRAINT pk_alias_events PRIMARY KEY (id);
ALTER TABLE ONLY aliases
    ADD CONSTRAINT pk_aliases PRIMARY KEY (league, name);
ALTER TABLE ONLY api_keys
    ADD CONSTRAINT pk_api_keys PRIMARY KEY (id);
ALTER TABLE ONLY change_counter
    ADD CONSTRAINT pk_change_counter PRIMARY KEY (id);
ALTER TABLE ONLY earlier_games
    ADD CONSTRAINT pk_earlier_games PRIMARY KEY (league, digest);
ALTER TABLE ONLY evaluations
    ADD CONSTRAINT pk_evaluations PRIMARY KEY (id);
ALTER TABLE ONLY idempotent_calls
    ADD CONSTRAINT pk_idempotent_calls PRIMARY KEY (owner, key);
ALTER TABLE ONLY leagues
    ADD CONSTRAINT pk_leagues PRIMARY KEY (slug);
ALTER TABLE ONLY matches
    ADD CONSTRAINT pk_matches PRIMARY KEY (schedule, "position");
ALTER TABLE ONLY nightly_runs
    ADD CONSTRAINT pk_nightly_runs PRIMARY KEY (id);
ALTER TABLE ONLY replicas
    ADD CONSTRAINT pk_replicas PRIMARY KEY (replica);
ALTER TABLE ONLY reports
    ADD CONSTRAINT pk_reports PRIMARY KEY (replica);
ALTER TABLE ONLY run_points
    ADD CONSTRAINT pk_run_points PRIMARY KEY (league, run, steps);
ALTER TABLE ONLY runs
    ADD CONSTRAINT pk_runs PRIMARY KEY (league, id);
ALTER TABLE ONLY schedules
    ADD CONSTRAINT pk_schedules PRIMARY KEY (sequence);
ALTER TABLE ONLY shadow_counts
    ADD CONSTRAINT pk_shadow_counts PRIMARY KEY (replica, league, candidate, champion);
ALTER TABLE ONLY snapshots
    ADD CONSTRAINT pk_snapshots PRIMARY KEY (league, part);
ALTER TABLE ONLY strengths
    ADD CONSTRAINT pk_strengths PRIMARY KEY (league, version, opponent);
ALTER TABLE ONLY traffic_events
    ADD CONSTRAINT pk_traffic_events PRIMARY KEY (id);
ALTER TABLE ONLY training_nights
    ADD CONSTRAINT pk_training_nights PRIMARY KEY (id);
ALTER TABLE ONLY verdicts
    ADD CONSTRAINT pk_verdicts PRIMARY KEY (id);
ALTER TABLE ONLY version_notes
    ADD CONSTRAINT pk_version_notes PRIMARY KEY (id);
ALTER TABLE ONLY versions
    ADD CONSTRAINT pk_versions PRIMARY KEY (league, number);
ALTER TABLE ONLY api_keys
    ADD CONSTRAINT uq_api_keys_name UNIQUE (name);
ALTER TABLE ONLY api_keys
    ADD CONSTRAINT uq_api_keys_sha256 UNIQUE (sha256);
ALTER TABLE ONLY schedules
    ADD CONSTRAINT uq_schedules_id UNIQUE (id);
CREATE INDEX ix_acknowledgements_seen_at ON acknowledgements USING btree (seen_at);
CREATE INDEX ix_alias_events_league_alias_id ON alias_events USING btree (league, alias, id);
CREATE INDEX ix_evaluations_league_id ON evaluations USING btree (league, id);
CREATE INDEX ix_evaluations_state ON evaluations USING btree (state);
CREATE INDEX ix_idempotent_calls_at ON idempotent_calls USING btree (at);
CREATE INDEX ix_matches_league_first_second_played_at ON matches USING btree (league, first, second, played_at);
CREATE INDEX ix_matches_league_played_at ON matches USING btree (league, played_at);
CREATE INDEX ix_nightly_runs_league_id ON nightly_runs USING btree (league, id);
CREATE INDEX ix_replicas_seen_at ON replicas USING btree (seen_at);
CREATE INDEX ix_reports_at ON reports USING btree (at);
CREATE INDEX ix_schedules_league ON schedules USING btree (league);
CREATE INDEX ix_shadow_counts_at ON shadow_counts USING btree (at);
CREATE INDEX ix_strengths_league_run ON strengths USING btree (league, run);
CREATE INDEX ix_traffic_events_league_id ON traffic_events USING btree (league, id);
CREATE INDEX ix_training_nights_league_id ON training_nights USING btree (league, id);
CREATE INDEX ix_verdicts_league ON verdicts USING btree (league);
CREATE INDEX ix_version_notes_league_id ON version_notes USING btree (league, id);
CREATE INDEX ix_version_notes_league_version_id ON version_notes USING btree (league, version, id);
CREATE UNIQUE INDEX uq_versions_ready_source ON versions USING btree (league, source) WHERE ((state)::text = 'ready'::text);
ALTER TABLE ONLY acknowledgements
    ADD CONSTRAINT fk_acknowledgements_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY alias_events
    ADD CONSTRAINT fk_alias_events_beneath FOREIGN KEY (beneath) REFERENCES alias_events(id);
ALTER TABLE ONLY alias_events
    ADD CONSTRAINT fk_alias_events_league_version FOREIGN KEY (league, version) REFERENCES versions(league, number);
ALTER TABLE ONLY alias_events
    ADD CONSTRAINT fk_alias_events_verdict FOREIGN KEY (verdict) REFERENCES verdicts(id);
ALTER TABLE ONLY aliases
    ADD CONSTRAINT fk_aliases_event FOREIGN KEY (event) REFERENCES alias_events(id);
ALTER TABLE ONLY aliases
    ADD CONSTRAINT fk_aliases_league_version FOREIGN KEY (league, version) REFERENCES versions(league, number);
ALTER TABLE ONLY earlier_games
    ADD CONSTRAINT fk_earlier_games_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY evaluations
    ADD CONSTRAINT fk_evaluations_key FOREIGN KEY (key) REFERENCES api_keys(id);
ALTER TABLE ONLY evaluations
    ADD CONSTRAINT fk_evaluations_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY idempotent_calls
    ADD CONSTRAINT fk_idempotent_calls_evaluation FOREIGN KEY (evaluation) REFERENCES evaluations(id);
ALTER TABLE ONLY idempotent_calls
    ADD CONSTRAINT fk_idempotent_calls_event FOREIGN KEY (event) REFERENCES alias_events(id);
ALTER TABLE ONLY idempotent_calls
    ADD CONSTRAINT fk_idempotent_calls_owner FOREIGN KEY (owner) REFERENCES api_keys(id);
ALTER TABLE ONLY idempotent_calls
    ADD CONSTRAINT fk_idempotent_calls_traffic FOREIGN KEY (traffic) REFERENCES traffic_events(id);
ALTER TABLE ONLY matches
    ADD CONSTRAINT fk_matches_schedule FOREIGN KEY (schedule) REFERENCES schedules(id);
ALTER TABLE ONLY nightly_runs
    ADD CONSTRAINT fk_nightly_runs_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY run_points
    ADD CONSTRAINT fk_run_points_league_run FOREIGN KEY (league, run) REFERENCES runs(league, id);
ALTER TABLE ONLY runs
    ADD CONSTRAINT fk_runs_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY schedules
    ADD CONSTRAINT fk_schedules_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY shadow_counts
    ADD CONSTRAINT fk_shadow_counts_league_candidate FOREIGN KEY (league, candidate) REFERENCES versions(league, number);
ALTER TABLE ONLY shadow_counts
    ADD CONSTRAINT fk_shadow_counts_league_champion FOREIGN KEY (league, champion) REFERENCES versions(league, number);
ALTER TABLE ONLY snapshots
    ADD CONSTRAINT fk_snapshots_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY strengths
    ADD CONSTRAINT fk_strengths_league_version FOREIGN KEY (league, version) REFERENCES versions(league, number);
ALTER TABLE ONLY traffic_events
    ADD CONSTRAINT fk_traffic_events_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY training_nights
    ADD CONSTRAINT fk_training_nights_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY verdicts
    ADD CONSTRAINT fk_verdicts_league_candidate FOREIGN KEY (league, candidate) REFERENCES versions(league, number);
ALTER TABLE ONLY version_notes
    ADD CONSTRAINT fk_version_notes_league_version FOREIGN KEY (league, version) REFERENCES versions(league, number);
ALTER TABLE ONLY versions
    ADD CONSTRAINT fk_versions_league FOREIGN KEY (league) REFERENCES leagues(slug);
ALTER TABLE ONLY versions
    ADD CONSTRAINT fk_versions_league_parent FOREIGN KEY (league, parent) REFERENCES versions(league, number);
