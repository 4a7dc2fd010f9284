-- held.sqlite as d36707ca wrote it: a robot is away that has acked one of an operator's three commands.
CREATE TABLE session (
    id INTEGER PRIMARY KEY, name TEXT, address TEXT, email TEXT, temporary INTEGER, received INTEGER, numbered INTEGER);
INSERT INTO session VALUES(1,'robot','127.0.0.1','',0,0,3);
INSERT INTO session VALUES(2,'operator','127.0.0.1','',0,3,0);
CREATE TABLE durable (session INTEGER, id TEXT, pattern TEXT, PRIMARY KEY (session, id)) WITHOUT ROWID;
INSERT INTO durable VALUES(1,'a','^/robots/a/command$');
INSERT INTO durable VALUES(1,'b','\pL+\z');
CREATE TABLE message (
    id INTEGER PRIMARY KEY, sender INTEGER, seq INTEGER, topic TEXT, frame BLOB, receivers INTEGER,
    waiting INTEGER, lost INTEGER);
INSERT INTO message VALUES(2,2,2,'/robots/a/command',X'62520101011100040800000000000001000000000000000200066133d351ec252f726f626f74732f612f636f6d6d616e646a736f6e6f70657261746f7232',1,1,0);
INSERT INTO message VALUES(3,2,3,'/robots/a/command',X'62520101011100040800000000000001000000000000000300066133d351ed922f726f626f74732f612f636f6d6d616e646a736f6e6f70657261746f7233',1,1,0);
CREATE TABLE delivery (
    session INTEGER, number INTEGER, message INTEGER, PRIMARY KEY (session, number)) WITHOUT ROWID;
INSERT INTO delivery VALUES(1,2,2);
INSERT INTO delivery VALUES(1,3,3);
